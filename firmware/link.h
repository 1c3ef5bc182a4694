/* The host's link: slave on SPI2 without chip select, transfers of one fixed length, and a pin that
 * says that a frame waits. */
#ifndef LINK_H
#define LINK_H

#include "frames.h"

extern const char build_id[32];

void link_init(void);
void link_frame(struct frame *frame); /* is complete, and the link's from here on */
void link_status(uint32_t refusal);   /* answer to a command; not in original framing */
void link_framing(uint32_t mode);     /* of the next transfer */
bool link_streams(void);              /* framing is not original */
void link_abandon(void);     /* no frame of before is offered any more */
    /* original mode: the offer ends with the period */
void link_tick(void);        /* every TICK_US */

void command_received(const uint8_t *bytes); /* in main.c; COMMAND_SIZE bytes */

#endif
