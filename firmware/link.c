/* Framing is by count alone: both sides know how many bytes a transfer has. So a transfer that
 * rests too long is given up, and wherever the first byte must be right, the peripheral is reset:
 * nothing else empties a transmit buffer that already holds a byte.
 *
 * Original framing runs on, transfer after transfer, as hosts of the original firmware expect; it
 * is begun anew when a frame is ready and no transfer under way. In stream and spikes framing, which
 * differ in length, every transfer is armed singly. */
#include "link.h"

#include "board.h"
#include "command.h"
#include "sensor.h"

#define RX (&DMA1->stream[3]) /* channel 0: SPI2_RX */
#define TX (&DMA1->stream[4]) /* channel 0: SPI2_TX */
#define RX_FLAGS(flags) ((flags) << 22)
#define SCK_LINE (1u << SCLK_PIN)
#ifdef __clang__
#define COMPILER "clang" STRING(__clang_major__)
#else
#define COMPILER "gcc" STRING(__GNUC__)
#endif
#define STRING(macro) STRING_OF(macro)
#define STRING_OF(text) #text
#define BUILD_ID "linetrack " VERSION " " COMPILER " " SOURCES /* the latter two: see Makefile */
#define STALL_TICKS (STREAM_STALL_US / TICK_US)
/* A command of original length in spikes framing, in whole transfers of that. */
#define HELD_MIN (ORIGINAL_SIZE / SPIKES_FRAME_SIZE * SPIKES_FRAME_SIZE)
#define ORIGINAL_STALL_TICKS (STREAM_ORIGINAL_STALL_US / TICK_US)

/* NUL padded; kept by the linker script, so that an image tells what it is */
const char build_id[sizeof status_frame.status.build] = BUILD_ID;
_Static_assert(sizeof BUILD_ID <= sizeof build_id, "build id too long");

static _Alignas(4) uint8_t received[STREAM_FRAME_SIZE];
static _Alignas(4) uint8_t head[COMMAND_SIZE]; /* what a command would be in */

/* Shared by the interrupts of the link, of frames and of SysTick; changed with interrupts off. */
static uint32_t framing;      /* a MODE_ */
static volatile bool busy;   /* a transfer has begun, or its end is being dealt with */
static struct frame *armed;  /* is sent by the transfer that runs or comes */
static bool offered;         /* it was, with the ready pin */
static struct frame *queued; /* complete, waits for the link; the newest wins */
static bool status_due;      /* the status frame is to be offered next */
static bool status_sealed;   /* its checksum is right */
static uint8_t lost;         /* flags for the next frame: those of frames not sent, and that */
static uint32_t left_before, rest_ticks;
static uint32_t held;        /* spikes framing: bytes received of a transfer that is a command */

static uint32_t transfer_size(void)
{
    static const uint16_t sizes[] = {[MODE_ORIGINAL] = ORIGINAL_SIZE,
                                     [MODE_STREAM] = STREAM_FRAME_SIZE,
                                     [MODE_SPIKES] = SPIKES_FRAME_SIZE};
    return sizes[framing];
}

/* In spikes framing twice as much, around and around: a command may be longer. */
static uint32_t receive_size(void)
{
    return framing == MODE_SPIKES ? 2u * SPIKES_FRAME_SIZE : transfer_size();
}

static void stop(void)
{
    RX->CR = 0;
    TX->CR = 0;
    while ((RX->CR | TX->CR) & DMA_CR_EN) {
    }
    DMA1->LIFCR = RX_FLAGS(DMA_ISR_ALL);
    DMA1->HIFCR = DMA_ISR_ALL;
}

static void watch_clock(void)
{
    busy = false;
    rest_ticks = 0;
    held = 0;
    left_before = receive_size();
    EXTI->PR = SCK_LINE;
    EXTI->IMR |= SCK_LINE;
}

static void arm(struct frame *frame, bool offer)
{
    armed = frame;
    offered = offer;
    pin_low(READY_PORT, READY_PIN); /* each offer has an edge of its own */
    stop();
    dma_barrier();
    RCC->APB1RSTR = RCC_APB1RSTR_SPI2RST;
    RCC->APB1RSTR = 0;
    const uint32_t around = framing == MODE_ORIGINAL ? DMA_CR_CIRC : 0;
    const uint32_t receive = framing == MODE_STREAM ? 0 : DMA_CR_CIRC;
    RX->NDTR = receive_size();
    RX->CR = receive | DMA_CR_MINC | DMA_CR_PL_HIGH | DMA_CR_HTIE | DMA_CR_TCIE | DMA_CR_EN;
    TX->M0AR = link_streams() ? dma_address(frame) : dma_address(frame->elements);
    TX->NDTR = transfer_size();
    TX->CR = around | DMA_CR_MINC | DMA_CR_PL_HIGH | DMA_CR_DIR_TO_PERIPHERAL | DMA_CR_EN;
    SPI2->CR2 = SPI_CR2_RXDMAEN | SPI_CR2_TXDMAEN;
    SPI2->CR1 = SPI_CR1_SSM | SPI_CR1_SPE; /* slave, mode 0, always selected */
    watch_clock();
    if (offer)
        pin_high(READY_PORT, READY_PIN);
}

/* The interrupt of the clock's first edge may still be pending. */
static bool transfer_begun(void)
{
    return busy || (EXTI->PR & SCK_LINE) || RX->NDTR != receive_size();
}

/* What was lost shows in the next frame that is sent, whose checksum has been computed already. */
static void offer_frame(struct frame *frame)
{
    static const uint32_t checksums[][4] = {{STREAM_FLAG_CHECKSUMS}, {SPIKES_FLAG_CHECKSUMS}};
    const uint32_t added = lost & ~(uint32_t)frame->header.flags;
    for (uint32_t n = 0; n < sizeof checksums[0] / sizeof checksums[0][0]; n++)
        if (added >> n & 1u)
            *frame_crc(frame) ^= checksums[frame->is_brief][n];
    frame->header.flags |= lost;
    lost = 0;
    arm(frame, true);
}

static void drop(struct frame *frame)
{
    lost |= FLAG_DROPPED | frame->header.flags;
    frame_release(frame);
}

static void enqueue(struct frame *frame)
{
    if (queued)
        drop(queued);
    queued = frame;
}

/* Not in original framing; no transfer under way, nothing armed. A status frame goes first. */
static void arm_next(void)
{
    if (status_due && status_sealed) {
        status_due = false;
        arm(&status_frame, true);
    } else if (queued && !status_due) {
        struct frame *frame = queued;
        queued = NULL;
        offer_frame(frame);
    } else {
        arm(&status_frame, false); /* not offered: a command may come all the same */
    }
}

void link_frame(struct frame *frame)
{
    const uint32_t masked = irq_save();
    if (frame == &status_frame) {
        status_sealed = true;
        if (link_streams() && status_due && !transfer_begun()) {
            arm_next();
        }
    } else if (frame->stale) {
        frame_release(frame);
    } else if (transfer_begun() || status_due || offered) {
        /* What is offered stays so: its transfer may begin while another frame is armed. */
        enqueue(frame);
        if (!link_streams() && offered && !transfer_begun()) {
            pin_low(READY_PORT, READY_PIN); /* hosts of the published firmware wait for an edge */
            pin_high(READY_PORT, READY_PIN);
        }
    } else if (link_streams()) {
        offer_frame(frame);
    } else {
        frame_release(armed);
        arm(frame, true);
    }
    irq_restore(masked);
}

void link_status(uint32_t refusal)
{
    uint32_t sh_period, icg_period;
    sensor_periods(&sh_period, &icg_period);
    const uint32_t masked = irq_save();
    status_frame.header = (struct header){
        .magic = STREAM_MAGIC,
        .version = framing == MODE_SPIKES ? SPIKES_VERSION : STREAM_VERSION,
        .flags = FLAG_STATUS,
        .icg_period = icg_period,
        .sh_period = sh_period,
    };
    status_frame.is_brief = framing == MODE_SPIKES;
    status_frame.brief.crc = 0;
    status_frame.status.refusal = refusal;
    status_frame.status.reserved = 0;
    for (uint32_t n = 0; n < sizeof build_id; n++)
        status_frame.status.build[n] = build_id[n];
    status_sealed = false;
    status_due = true;
    irq_restore(masked);
    frame_seal(&status_frame);
}

void link_framing(uint32_t mode)
{
    const uint32_t masked = irq_save();
    if (framing != mode) {
        pin_low(READY_PORT, READY_PIN);
        link_abandon();
        status_due = false;
        stop();
        if (mode == MODE_ORIGINAL) {
            armed = frame_take(); /* whatever it holds: nothing has been read out yet */
        } else {
            frame_release(armed);
            armed = &status_frame;
            busy = true; /* until armed anew */
        }
        offered = false;
        framing = mode;
        if (mode == MODE_ORIGINAL)
            arm(armed, false);
    }
    irq_restore(masked);
}

bool link_streams(void)
{
    return framing != MODE_ORIGINAL;
}

void link_abandon(void)
{
    const uint32_t masked = irq_save();
    if (queued)
        frame_release(queued);
    queued = NULL;
    lost = 0;
    frames_abandon();
    irq_restore(masked);
}

/* A transfer is through; `head` has its beginning. */
static void complete(void)
{
    uint32_t masked = irq_save();
    if (link_streams()) {
        busy = true; /* until armed anew */
        pin_low(READY_PORT, READY_PIN);
        frame_release(armed);
        armed = &status_frame;
        offered = false;
    } else {
        offered = false;
        watch_clock(); /* the next transfer may come at once */
    }
    irq_restore(masked);

    if (command_present(head))
        command_received(head);

    masked = irq_save();
    if (link_streams()) {
        arm_next();
    } else if (queued && !transfer_begun()) {
        frame_release(armed);
        arm(queued, true);
        queued = NULL;
    }
    irq_restore(masked);
}

static void keep_head(const uint8_t *bytes, uint32_t at, uint32_t size)
{
    const uint32_t *from = (const uint32_t *)(const void *)bytes;
    uint32_t *to = (uint32_t *)(void *)head;
    for (uint32_t n = 0; n < size / 4u && at / 4u + n < sizeof head / 4u; n++)
        to[at / 4u + n] = from[n];
}

/* Spikes framing. A host that does not know of it sends a command in a transfer of original length,
 * which is obeyed when the clock rests. */
static void block_received(const uint8_t *bytes)
{
    keep_head(bytes, held, SPIKES_FRAME_SIZE);
    if (!held && (!command_present(head) || command_brief(head))) {
        complete();
        return;
    }
    const uint32_t masked = irq_save();
    held += SPIKES_FRAME_SIZE;
    irq_restore(masked);
}

void DMA1_Stream3_IRQHandler(void)
{
    const uint32_t flags = DMA1->LISR & RX_FLAGS(DMA_ISR_HTIF | DMA_ISR_TCIF);
    DMA1->LIFCR = flags;
    dma_barrier();
    if (framing == MODE_SPIKES) {
        if (flags & RX_FLAGS(DMA_ISR_HTIF))
            block_received(received);
        if ((flags & RX_FLAGS(DMA_ISR_TCIF)) && held)
            block_received(received + SPIKES_FRAME_SIZE);
        return;
    }
    if (flags & RX_FLAGS(DMA_ISR_HTIF)) /* by half-time: the next transfer may overwrite it */
        keep_head(received, 0, sizeof head);
    if (flags & RX_FLAGS(DMA_ISR_TCIF))
        complete();
}

/* The first edge of SCK: the transfer of what was offered has begun. */
void EXTI15_10_IRQHandler(void)
{
    const uint32_t masked = irq_save();
    if (EXTI->PR & SCK_LINE) {
        EXTI->IMR &= ~SCK_LINE;
        EXTI->PR = SCK_LINE;
        busy = true;
        pin_low(READY_PORT, READY_PIN);
    }
    irq_restore(masked);
}

/* Gives up a transfer that rests. Returns whether it was one, and how many bytes were missing. */
static bool stalled(uint32_t *missing)
{
    const uint32_t left = RX->NDTR;
    if (!transfer_begun() || left != left_before || (DMA1->LISR & RX_FLAGS(DMA_ISR_TCIF))) {
        left_before = left;
        rest_ticks = 0;
        return false;
    }
    if (++rest_ticks < (link_streams() ? STALL_TICKS : ORIGINAL_STALL_TICKS))
        return false;
    stop();
    busy = true; /* until armed anew */
    *missing = left;
    return true;
}

void link_tick(void)
{
    uint32_t missing;
    uint32_t masked = irq_save();
    const bool gave_up = stalled(&missing);
    irq_restore(masked);
    if (!gave_up)
        return;
    /* A host that does not know of stream framing sends a command of original length. */
    if (held >= HELD_MIN || (framing == MODE_STREAM && STREAM_FRAME_SIZE - missing >= ORIGINAL_SIZE &&
                 command_present(head))) {
        complete();
        return;
    }
    masked = irq_save();
    if (!link_streams()) {
        if (queued) {
            frame_release(armed);
            armed = queued;
            offered = true;
            queued = NULL;
        }
        arm(armed, offered);
    } else {
        if (armed != &status_frame && !status_due) {
            arm(armed, true); /* once more, so that a broken transfer costs its own frame only */
        } else {
            if (armed == &status_frame)
                status_due = status_due || offered;
            else if (queued)
                drop(armed);
            else
                queued = armed;
            arm_next();
        }
    }
    irq_restore(masked);
}

void link_init(void)
{
    RX->PAR = dma_address(&SPI2->DR);
    RX->M0AR = dma_address(received);
    TX->PAR = dma_address(&SPI2->DR);
    SYSCFG->EXTICR4 = 1u << SYSCFG_EXTICR4_EXTI13; /* port B */
    EXTI->RTSR |= SCK_LINE;
    arm(frame_take(), false);
    irq_enable(IRQ_DMA1_STREAM3, PRIORITY_LINK);
    irq_enable(IRQ_EXTI15_10, PRIORITY_LINK);
}
