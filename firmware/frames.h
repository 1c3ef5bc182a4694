/* Buffers for read-outs, laid out as stream mode sends them, and their checksums. */
#ifndef FRAMES_H
#define FRAMES_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "wiring.h"

struct header {
    uint16_t magic;
    uint8_t version;
    uint8_t flags;
    uint32_t sequence;   /* read-outs since the stream's start */
    uint64_t leds;       /* that were lit */
    uint64_t timestamp;  /* master clocks since boot, at the end of the integration */
    uint32_t icg_period; /* master clocks */
    uint32_t sh_period;
};
_Static_assert(sizeof(struct header) == STREAM_HEADER_SIZE, "no padding");

/* At the shortest ICG periods the ADC never stops: it also converts what comes between the last
 * element of a read-out and the first of the next. That lands in crc and spare, unused then. */
#define SPARE_ELEMENTS 32u

struct status {
    uint32_t refusal;
    uint32_t reserved;
    char build[32]; /* NUL padded */
};

struct frame {
    struct header header;
    union {
        uint16_t elements[ELEMENTS];
        struct status status;
    };
    uint32_t crc;
    uint16_t spare[SPARE_ELEMENTS];
    bool in_use;
    bool stale; /* its acquisition has been given up: not to be sent */
};
_Static_assert(offsetof(struct frame, crc) == STREAM_FRAME_SIZE - 4u, "as it is sent");

extern struct frame status_frame;

void frames_init(void);
struct frame *frame_take(void);
void frame_release(struct frame *frame); /* not the status frame: nothing happens */
/* Computes the checksum, by DMA in 0.2 ms at most, then calls frame_sealed. */
void frame_seal(struct frame *frame);
void frames_abandon(void); /* those being sealed are stale */

void frame_sealed(struct frame *frame); /* in main.c */

#endif
