/* The sensor: its clocks (TIM3 fM, TIM2 SH, TIM5 ICG), the ADC (TIM4, ADC1, DMA2), and which
 * read-outs are taken. */
#ifndef SENSOR_H
#define SENSOR_H

#include "command.h"

void sensor_init(void);
struct plan *sensor_spare_plan(void); /* for the next command; in no other use */
/* Flushes the sensor, then takes the plan's read-outs; with await_sync, at the next edge on that
 * line, so that all that see it read out together. Whatever went on before is given up. */
void sensor_acquire(struct plan *plan);
/* Takes over the plan's table and count without interrupting the stream that runs. Returns false
 * if none runs, or one with other periods or in another mode, or if the plan awaits an edge. */
bool sensor_exchange(struct plan *plan);
void sensor_halt(void);
/* Of the read-outs that are taken, or will be after the flush or the edge; original if none are. */
uint32_t sensor_mode(void);
bool sensor_awaits(void); /* an edge */
void sensor_mark_refusal(void); /* in the next frame's header */
void sensor_periods(uint32_t *sh_period, uint32_t *icg_period); /* the last good ones */
void sensor_queue_frame(void); /* a frame may have become free */

#endif
