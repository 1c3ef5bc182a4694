/* Buffers for read-outs, laid out as stream mode sends them, and their checksums. */
#ifndef FRAMES_H
#define FRAMES_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "spikes.h"
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

/* What is sent in spikes mode after the header. */
struct brief {
    struct found found;
    uint8_t unused[SPIKES_FRAME_SIZE - STREAM_HEADER_SIZE - sizeof(struct found) - 4u];
    uint32_t crc;
};
_Static_assert(sizeof(struct brief) == SPIKES_FRAME_SIZE - STREAM_HEADER_SIZE, "no padding");

struct frame {
    struct header header;
    union {
        uint16_t elements[ELEMENTS];
        struct status status;
        struct brief brief;
        uint32_t brief_words[sizeof(struct brief) / 4u];
    };
    uint32_t crc;
    uint16_t spare[SPARE_ELEMENTS];
    struct search search;
    bool is_brief; /* laid out as in spikes mode, or will be when it has been searched */
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
uint32_t *frame_crc(struct frame *frame);
/* Lets frames_search find the spikes of a frame, which takes their place; then it is sealed. If
 * another one waits, that is missed. */
void frame_search(struct frame *frame);
bool frames_unsearched(void);
void frames_search(void);  /* where everything else interrupts */
void frames_abandon(void); /* those being searched or sealed are stale */

void frame_sealed(struct frame *frame); /* in main.c */

#endif
