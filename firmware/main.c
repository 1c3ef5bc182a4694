#include "board.h"
#include "command.h"
#include "frames.h"
#include "lights.h"
#include "link.h"
#include "sensor.h"

static void original_command(struct plan *plan, uint32_t refusal)
{
    if (link_streams())
        sensor_halt();
    link_framing(MODE_ORIGINAL);
    if (plan->count == 0)
        return;
    if (refusal)
        sensor_periods(&plan->sh_period, &plan->icg_period); /* the last good ones */
    sensor_acquire(plan);
}

static void stream_command(struct plan *plan, uint32_t refusal)
{
    const uint32_t running = sensor_mode();
    /* A host that wants another mode would not understand what goes on; but with a wrong checksum
     * the mode may be wrong as well. */
    if (refusal && running != MODE_ORIGINAL &&
        (refusal == REFUSAL_CHECKSUM || plan->mode == running)) {
        if (sensor_awaits())
            link_status(refusal);
        else
            sensor_mark_refusal();
        return;
    }
    if (!refusal && sensor_exchange(plan))
        return;
    if (refusal)
        sensor_halt(); /* original framing's frames do not fit in */
    link_framing(plan->mode == MODE_SPIKES ? MODE_SPIKES : MODE_STREAM);
    if (!refusal)
        sensor_acquire(plan);
    link_status(refusal);
}

void command_received(const uint8_t *bytes)
{
    struct plan *plan = sensor_spare_plan();
    const uint32_t refusal = command_read(bytes, plan);
    if (plan->mode == MODE_ORIGINAL)
        original_command(plan, refusal);
    else
        stream_command(plan, refusal);
}

void frame_sealed(struct frame *frame)
{
    link_frame(frame);
    sensor_queue_frame();
}

void SysTick_Handler(void)
{
    link_tick();
}

int main(void)
{
    board_init();
    lights_init();
    frames_init();
    sensor_init();
    link_init();
    /* All work but one is done by interrupts. One that comes between the question and wfi ends it. */
    for (;;) {
        const uint32_t masked = irq_save();
        if (!frames_unsearched())
            __asm__ volatile("wfi");
        irq_restore(masked);
        frames_search();
    }
}
