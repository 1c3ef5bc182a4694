/* Spikes in a read-out: where light lowers the elements. Integers only and pure: no register is
 * touched, so this part is also compiled and tested on the host, bit for bit against
 * tracking/onboard.py, which explains it. */
#ifndef SPIKES_H
#define SPIKES_H

#include <stdbool.h>
#include <stdint.h>

#include "wiring.h"

struct window {
    uint16_t first, last; /* pixels */
};

/* What a command asks for, of one frame. */
struct search {
    uint16_t saturated; /* light with which a pixel is full, counts below dark; 0: unknown */
    uint16_t threshold; /* light that a spike must have, counts over 8 pixels; 0: above the noise */
    uint8_t count;      /* of windows, none of which overlap */
    bool alone;         /* light in a window is of one LED */
    struct window windows[SPIKES_WINDOWS_MAX];
};

/* These two as they are sent. */
struct spike {
    uint32_t position; /* of the line, 1/SPIKES_POSITION_SCALE px */
    uint16_t width;    /* at half maximum, 1/SPIKES_WIDTH_SCALE px */
    uint16_t height;   /* counts */
    uint8_t flags;
    uint8_t window;
    uint8_t reserved[2];
};

struct found {
    uint8_t count;
    uint8_t window_count;
    uint16_t dark; /* 1/SPIKES_DARK_SCALE counts */
    uint32_t reserved;
    struct window windows[SPIKES_WINDOWS_MAX];
    struct spike spikes[SPIKES_SPIKES_MAX];
};

/* Not reentrant. */
void spikes_find(const uint16_t *elements, const struct search *search, struct found *found);

#endif
