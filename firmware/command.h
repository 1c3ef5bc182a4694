/* Commands from the host: what they say, and whether that can be done. Pure: no register is
 * touched, so this part is also compiled and tested on the host. */
#ifndef COMMAND_H
#define COMMAND_H

#include <stdbool.h>
#include <stdint.h>

#include "spikes.h"
#include "wiring.h"

/* Bytes of a transfer that can belong to a command: the longest is one of spikes mode. */
#define COMMAND_SIZE (SPIKES_TABLE_AT + STREAM_TABLE_MAX * SPIKES_ENTRY_SIZE + 4u)
#define NO_STEP 0xFFu

/* During an exposure: from this time on, these LEDs are lit. */
struct step {
    uint64_t leds;
    uint32_t tick;      /* master clocks after the ICG edge that the period begins with */
    uint8_t latch;      /* 1: the chain shows another pattern from here on */
    uint8_t next_latch; /* next step for which that is so, in this frame or a later one */
    uint8_t reserved[2];
};

struct plan {
    uint32_t sh_period; /* master clocks */
    uint32_t icg_period;
    uint32_t count; /* read-outs; 0: endless, not in original mode */
    uint8_t mode;
    uint8_t frames; /* in the table, which is used over and over */
    uint8_t first_step[STREAM_TABLE_MAX + 1u]; /* of a frame; that of the next ends it */
    struct step steps[STREAM_TABLE_MAX];
    /* spikes mode */
    struct window windows[STREAM_TABLE_MAX];
    uint8_t first_window[STREAM_TABLE_MAX + 1u]; /* as first_step */
    uint16_t saturated, threshold;
    bool await_sync; /* begin with an edge of that line */
};

/* CRC-32/MPEG-2 as the CRC unit computes it over little-endian words. */
uint32_t crc_words(const uint8_t *bytes, uint32_t words);

bool command_present(const uint8_t *bytes);
bool command_brief(const uint8_t *bytes); /* in a transfer of spikes mode's length */
bool periods_valid(uint32_t sh_period, uint32_t icg_period);

/* Reads COMMAND_SIZE bytes. Returns a refusal; whatever it is, mode, periods and count of the plan
 * are those of the command. */
uint32_t command_read(const uint8_t *bytes, struct plan *plan);

#endif
