#include "frames.h"

#include "board.h"

/* At most at once: one is sent, one waits for that, one gets its checksum, the next is searched
 * already, one waits for that, one is filled, and with an ADC that never stops its successor is
 * chosen. */
#define FRAMES 7u

#define CRC_STREAM (&DMA2->stream[1])
#define CRC_FLAGS(flags) ((flags) << 6)

struct frame status_frame;
static struct frame frames[FRAMES];
static struct frame *sealing, *waiting; /* a frame and the status frame can meet, not more */
static struct frame *searching;
static struct frame *volatile unsearched;

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

uint32_t *frame_crc(struct frame *frame)
{
    return frame->is_brief ? &frame->brief.crc : &frame->crc;
}

static void seal(struct frame *frame)
{
    sealing = frame;
    dma_barrier();
    CRC->CR = CRC_CR_RESET;
    DMA2->LIFCR = CRC_FLAGS(DMA_ISR_ALL);
    CRC_STREAM->PAR = dma_address(frame);
    CRC_STREAM->NDTR = ((frame->is_brief ? SPIKES_FRAME_SIZE : STREAM_FRAME_SIZE) - 4u) / 4u;
    CRC_STREAM->CR = DMA_CR_DIR_IN_MEMORY | DMA_CR_PINC | DMA_CR_PSIZE_32 | DMA_CR_MSIZE_32 |
                     DMA_CR_TCIE | DMA_CR_EN;
}

void frame_seal(struct frame *frame)
{
    const uint32_t masked = irq_save();
    if (!sealing)
        seal(frame);
    else
        waiting = frame; /* even if it is the same: it has been changed meanwhile */
    irq_restore(masked);
}

void frames_abandon(void)
{
    const uint32_t masked = irq_save();
    if (sealing)
        sealing->stale = sealing != &status_frame;
    if (waiting)
        waiting->stale = waiting != &status_frame;
    if (searching)
        searching->stale = true;
    if (unsearched)
        frame_release(unsearched);
    unsearched = NULL;
    irq_restore(masked);
}

void frame_search(struct frame *frame)
{
    const uint32_t masked = irq_save();
    if (unsearched) { /* the newest wins, and tells of the one that is missed */
        frame->header.flags |= FLAG_DROPPED | unsearched->header.flags;
        frame_release(unsearched);
    }
    unsearched = frame;
    irq_restore(masked);
}

bool frames_unsearched(void)
{
    return unsearched != NULL;
}

void frames_search(void)
{
    static union {
        struct brief brief;
        uint32_t words[sizeof(struct brief) / 4u];
    } result;
    uint32_t masked = irq_save();
    struct frame *frame = unsearched;
    searching = frame;
    unsearched = NULL;
    irq_restore(masked);
    if (!frame)
        return;
    dma_barrier();
    spikes_find(frame->elements, &frame->search, &result.brief.found);
    for (uint32_t n = 0; n < sizeof result.words / 4u; n++)
        frame->brief_words[n] = result.words[n];
    masked = irq_save();
    searching = NULL;
    if (frame->stale)
        frame_release(frame);
    else
        frame_seal(frame);
    irq_restore(masked);
}

void DMA2_Stream1_IRQHandler(void)
{
    if (!(DMA2->LISR & CRC_FLAGS(DMA_ISR_TCIF)))
        return;
    DMA2->LIFCR = CRC_FLAGS(DMA_ISR_ALL);
    struct frame *frame = sealing, *next = waiting;
    *frame_crc(frame) = CRC->DR;
    sealing = NULL;
    waiting = NULL;
    if (next)
        seal(next);
    if (next != frame)
        frame_sealed(frame);
}
