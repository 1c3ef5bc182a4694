/* The LEDs: six on pins, the others on a chain of 74HC595. */
#ifndef LIGHTS_H
#define LIGHTS_H

#include "command.h"

void lights_init(void);
/* The rest is called by the ICG interrupt, or with interrupts off. */
void lights_off(void);
void lights_on(uint64_t leds); /* on pins only */
/* Which LEDs the period that has just begun lights, and when. Returns them. */
uint64_t lights_plan(const struct plan *plan, uint32_t frame);
void lights_none(void);
void lights_step(void); /* does what is due, and asks TIM5's second compare for the next step */

#endif
