#include "frames.h"

#include "board.h"

/* At most at once: one is sent, one waits for that, one gets its checksum, one is filled. With an
 * ADC that never stops the next one is chosen while one is filled, but after the checksum. */
#define FRAMES 4u

#define CRC_STREAM (&DMA2->stream[1])
#define CRC_FLAGS(flags) ((flags) << 6)

struct frame status_frame;
static struct frame frames[FRAMES];
static struct frame *sealing, *waiting; /* a frame and the status frame can meet, not more */

void frames_init(void)
{
    CRC_STREAM->M0AR = dma_address(&CRC->DR);
    CRC_STREAM->FCR = DMA_FCR_DMDIS | DMA_FCR_FTH_FULL; /* from memory to memory needs the FIFO */
    irq_enable(IRQ_DMA2_STREAM1, PRIORITY_ADC);
}

struct frame *frame_take(void)
{
    const uint32_t masked = irq_save();
    uint32_t n = 0;
    while (frames[n].in_use)
        if (++n == FRAMES)
            __builtin_trap(); /* cannot be, see FRAMES */
    frames[n].in_use = true;
    frames[n].stale = false;
    irq_restore(masked);
    return &frames[n];
}

void frame_release(struct frame *frame)
{
    frame->in_use = false;
}

static void seal(struct frame *frame)
{
    sealing = frame;
    dma_barrier();
    CRC->CR = CRC_CR_RESET;
    DMA2->LIFCR = CRC_FLAGS(DMA_ISR_ALL);
    CRC_STREAM->PAR = dma_address(frame);
    CRC_STREAM->NDTR = (STREAM_FRAME_SIZE - 4u) / 4u;
    CRC_STREAM->CR = DMA_CR_DIR_IN_MEMORY | DMA_CR_PINC | DMA_CR_PSIZE_32 | DMA_CR_MSIZE_32 |
                     DMA_CR_TCIE | DMA_CR_EN;
}

void frame_seal(struct frame *frame)
{
    const uint32_t masked = irq_save();
    if (!sealing)
        seal(frame);
    else if (sealing != frame)
        waiting = frame;
    irq_restore(masked);
}

void frames_abandon(void)
{
    const uint32_t masked = irq_save();
    if (sealing)
        sealing->stale = sealing != &status_frame;
    if (waiting)
        waiting->stale = waiting != &status_frame;
    irq_restore(masked);
}

void DMA2_Stream1_IRQHandler(void)
{
    if (!(DMA2->LISR & CRC_FLAGS(DMA_ISR_TCIF)))
        return;
    DMA2->LIFCR = CRC_FLAGS(DMA_ISR_ALL);
    struct frame *frame = sealing;
    frame->crc = CRC->DR;
    sealing = NULL;
    if (waiting) {
        struct frame *next = waiting;
        waiting = NULL;
        seal(next);
    }
    frame_sealed(frame);
}
