/* DMA1 and DMA2: streams in direct mode, and memory to memory. */
#include <string.h>

#include "machine.h"

#define EN 1u
#define TEIE 4u
#define HTIE 8u
#define TCIE 0x10u
#define CIRC 0x100u
#define PINC 0x200u
#define MINC 0x400u
#define DBM 0x40000u
#define CT 0x80000u
#define FEIF 1u
#define DMEIF 4u
#define TEIF 8u
#define HTIF 0x10u
#define TCIF 0x20u
#define COPY_ITEMS 16u /* of memory to memory, at a time */
#define COPY_CYCLES 8u /* of each: a read, a write, the CRC unit's four wait states */

static const uint8_t irq_of[2][STREAMS] = {{11, 12, 13, 14, 15, 16, 17, 47},
                                           {56, 57, 58, 59, 60, 68, 69, 70}};
static const uint8_t flag_shift[4] = {0, 6, 16, 22};

enum port { PORT_OTHER, PORT_SPI2, PORT_SPI3, PORT_ADC, PORT_CRC };

enum line { LINE_NONE, LINE_RX, LINE_TX, LINE_ADC };

struct request {
    uint8_t dma, stream, channel, line, spi;
};

static const struct request requests[] = {
    {0, 3, 0, LINE_RX, 0}, {0, 4, 0, LINE_TX, 0}, {0, 0, 0, LINE_RX, 1},  {0, 2, 0, LINE_RX, 1},
    {0, 5, 0, LINE_TX, 1}, {0, 7, 0, LINE_TX, 1}, {1, 0, 0, LINE_ADC, 0}, {1, 4, 0, LINE_ADC, 0},
};

static const struct request *request_of(unsigned n, unsigned stream, unsigned channel) {
    for (size_t i = 0; i < sizeof requests / sizeof requests[0]; i++)
        if (requests[i].dma == n && requests[i].stream == stream && requests[i].channel == channel)
            return &requests[i];
    return NULL;
}

static unsigned direction(const struct stream *s) { return (s->cr >> 6) & 3; }
static unsigned item_size(const struct stream *s) { return 1u << ((s->cr >> 11) & 3); }
static unsigned channel_of(const struct stream *s) { return (s->cr >> 25) & 7; }

static uint32_t flags(const struct machine *m, unsigned n, unsigned stream) {
    return (m->dma[n].isr[stream / 4] >> flag_shift[stream % 4]) & 0x3Du;
}

static void irq(struct machine *m, unsigned n, unsigned stream) {
    uint32_t cr = m->dma[n].stream[stream].cr, f = flags(m, n, stream);
    bool on = ((f & TCIF) && (cr & TCIE)) || ((f & HTIF) && (cr & HTIE)) ||
              ((f & TEIF) && (cr & TEIE));
    irq_line(m, irq_of[n][stream], on);
}

static void raise_flag(struct machine *m, unsigned n, unsigned stream, uint32_t flag) {
    m->dma[n].isr[stream / 4] |= flag << flag_shift[stream % 4];
    irq(m, n, stream);
}

static uint32_t memory_address(const struct stream *s, uint32_t index) {
    uint32_t base = (s->cr & DBM) && (s->cr & CT) ? s->m1ar : s->m0ar;
    return base + ((s->cr & MINC) ? index * item_size(s) : 0);
}

static uint32_t peripheral_address(const struct stream *s, uint32_t index) {
    return s->par + ((s->cr & PINC) ? index * item_size(s) : 0);
}

static uint8_t port_at(uint32_t address) {
    switch (address) {
    case 0x4000380Cu: return PORT_SPI2;
    case 0x40003C0Cu: return PORT_SPI3;
    case 0x4001204Cu: return PORT_ADC;
    case 0x40023000u: return PORT_CRC;
    default: return PORT_OTHER;
    }
}

/* As bus_read and bus_write, with shortcuts to the usual data registers and to RAM. */
static uint32_t fetch(struct machine *m, uint32_t address, unsigned size, unsigned port) {
    uint32_t value = 0, offset = address - RAM_BASE;
    if (port == PORT_SPI2 || port == PORT_SPI3) return spi_read(m, port - PORT_SPI2, 0x0C);
    if (port == PORT_ADC) return adc_read(m, 0x4C);
    if (offset > RAM_SIZE - 4) return bus_read(m, address, size);
    memcpy(&value, m->ram + offset, size);
    return value;
}

static void store(struct machine *m, uint32_t address, unsigned size, uint32_t value,
                  unsigned port) {
    uint32_t offset = address - RAM_BASE;
    if (port == PORT_SPI2 || port == PORT_SPI3)
        spi_write(m, port - PORT_SPI2, 0x0C, value);
    else if (port == PORT_CRC && size == 4)
        crc_write(m, 0, value);
    else if (offset > RAM_SIZE - 4)
        bus_write(m, address, size, value);
    else
        memcpy(m->ram + offset, &value, size);
}

/* In direct mode a stream to a peripheral reads one datum before it is asked for. */
static void read_ahead(struct machine *m, struct stream *s) {
    if (direction(s) != 1 || s->has_ahead || !(s->cr & EN)) return;
    s->ahead = fetch(m, memory_address(s, s->index), item_size(s), PORT_OTHER);
    s->has_ahead = true;
}

/* One item is through. */
static void count_item(struct machine *m, unsigned n, unsigned stream) {
    struct stream *s = &m->dma[n].stream[stream];
    s->index++;
    s->ndtr--;
    if (s->ndtr == s->reload - s->reload / 2 && s->reload > 1) raise_flag(m, n, stream, HTIF);
    if (s->ndtr) return;
    s->index = 0;
    if (s->cr & DBM) s->cr ^= CT;
    if (s->cr & (CIRC | DBM))
        s->ndtr = s->reload;
    else
        s->cr &= ~EN;
    if (request_of(n, stream, channel_of(s)) && direction(s) == 0 && !(s->cr & EN) &&
        request_of(n, stream, channel_of(s))->line == LINE_ADC && !(m->adc.cr2 & 0x200u))
        m->adc.dma_done = true; /* DDS = 0 */
    raise_flag(m, n, stream, TCIF);
}

static void move_item(struct machine *m, unsigned n, unsigned stream) {
    struct stream *s = &m->dma[n].stream[stream];
    unsigned size = item_size(s);
    switch (direction(s)) {
    case 0:
        store(m, memory_address(s, s->index), size,
              fetch(m, peripheral_address(s, s->index), size, s->port), PORT_OTHER);
        count_item(m, n, stream);
        break;
    case 1: {
        read_ahead(m, s);
        uint32_t value = s->ahead, to = peripheral_address(s, s->index);
        s->has_ahead = false;
        count_item(m, n, stream);
        read_ahead(m, s);
        store(m, to, size, value, s->port); /* may raise the next request */
        break;
    }
    default: /* from what PAR points to */
        store(m, memory_address(s, s->index), size,
              fetch(m, peripheral_address(s, s->index), size, PORT_OTHER), s->port);
        count_item(m, n, stream);
    }
}

static bool asserted(const struct machine *m, const struct request *r) {
    if (r->line == LINE_RX) return spi_requests_rx(m, r->spi);
    if (r->line == LINE_TX) return spi_requests_tx(m, r->spi);
    return adc_requests(m);
}

void dma_request(struct machine *m, unsigned n, unsigned stream, unsigned channel) {
    struct stream *s = &m->dma[n].stream[stream];
    if (!(s->cr & EN) || channel_of(s) != channel || direction(s) == 2 || m->failed) return;
    move_item(m, n, stream);
}

/* --- memory to memory ----------------------------------------------------------------------- */
static void plan(struct machine *m) {
    bool any = false;
    for (unsigned i = 0; i < STREAMS; i++)
        any = any || ((m->dma[1].stream[i].cr & EN) && direction(&m->dma[1].stream[i]) == 2);
    machine_schedule(m, EVENT_DMA,
                     any ? m->now + (uint64_t)COPY_ITEMS * COPY_CYCLES * m->rcc.cpu : NEVER);
}

void dma_event(struct machine *m, uint64_t time) {
    (void)time;
    for (unsigned i = 0; i < STREAMS; i++) {
        struct stream *s = &m->dma[1].stream[i];
        if (direction(s) != 2) continue;
        for (unsigned k = 0; k < COPY_ITEMS && (s->cr & EN) && !m->failed; k++)
            move_item(m, 1, i);
    }
    plan(m);
}

/* --- registers ------------------------------------------------------------------------------ */
void dma_reset(struct machine *m, unsigned n) {
    m->dma[n] = (struct dma){0};
    for (unsigned i = 0; i < STREAMS; i++) {
        m->dma[n].stream[i].fcr = 0x21;
        irq_line(m, irq_of[n][i], false);
    }
    if (n == 1) m->at[EVENT_DMA] = NEVER;
}

uint32_t dma_read(struct machine *m, unsigned n, uint32_t offset) {
    const struct dma *d = &m->dma[n];
    if (offset < 8) return d->isr[offset / 4];
    if (offset >= 0x10 && offset < 0x10 + 0x18 * STREAMS) {
        const struct stream *s = &d->stream[(offset - 0x10) / 0x18];
        switch ((offset - 0x10) % 0x18) {
        case 0x00: return s->cr;
        case 0x04: return s->ndtr;
        case 0x08: return s->par;
        case 0x0C: return s->m0ar;
        case 0x10: return s->m1ar;
        default: return s->fcr;
        }
    }
    if (offset >= 0x10)
        fail(m, "%s is not modelled", register_name(m, 0x40026000u + 0x400u * n + offset));
    return 0;
}

static void enable(struct machine *m, unsigned n, unsigned stream) {
    struct stream *s = &m->dma[n].stream[stream];
    const char *name = register_name(m, 0x40026010u + 0x400u * n + 0x18u * stream);
    bool copy = direction(s) == 2, direct = !(s->fcr & 4);
    const struct request *r = request_of(n, stream, channel_of(s));
    s->reload = s->ndtr;
    s->index = 0;
    s->has_ahead = false;
    s->port = port_at(copy ? s->m0ar : s->par);
    uint32_t device = copy ? s->m0ar : s->par;
    if (s->port != PORT_OTHER && (!rcc_clocked(m, device) || rcc_held(m, device)))
        fail(m, "%s: what 0x%08X belongs to is not clocked", name, device);
    else if (flags(m, n, stream))
        fail(m, "%s: enabled while its flags 0x%02X in ISR are not cleared", name,
             flags(m, n, stream));
    else if (!s->ndtr)
        fail(m, "%s: enabled with NDTR = 0", name);
    else if (direction(s) == 3 || item_size(s) > 4)
        fail(m, "%s = 0x%08X: reserved direction or size", name, s->cr);
    else if (copy && n == 0)
        fail(m, "%s: DMA1 cannot copy memory to memory", name);
    else if (copy && (direct || (s->cr & (CIRC | DBM))))
        fail(m, "%s: memory to memory needs the FIFO and no circular mode", name);
    else if (!copy && !direct)
        fail(m, "%s: a FIFO between memory and peripheral is not modelled", name);
    else if (!direct && ((s->cr >> 11) & 3) != ((s->cr >> 13) & 3))
        fail(m, "%s: packing is not modelled", name);
    else if (!copy && !r)
        fail(m, "%s: request channel %u of this stream is not modelled", name, channel_of(s));
    else if (!copy && (direction(s) == 1) != (r->line == LINE_TX))
        fail(m, "%s: the direction does not fit its request", name);
    else if (n == 0 && s->par >= 0x40008000u)
        fail(m, "%s: DMA1's peripheral port reaches APB1 only, not 0x%08X", name, s->par);
    else if ((s->par | s->m0ar | ((s->cr & DBM) ? s->m1ar : 0)) % item_size(s))
        fail(m, "%s: unaligned address", name);
    if (m->failed) return;
    if (copy) {
        plan(m);
        return;
    }
    read_ahead(m, s);
    while (!m->failed && (s->cr & EN) && asserted(m, r)) {
        uint32_t before = s->ndtr;
        move_item(m, n, stream);
        if (s->ndtr == before) break; /* one item of circular length 1 */
    }
}

static void write_cr(struct machine *m, unsigned n, unsigned stream, uint32_t value) {
    struct stream *s = &m->dma[n].stream[stream];
    uint32_t address = 0x40026010u + 0x400u * n + 0x18u * stream;
    uint32_t own = EN | TEIE | HTIE | TCIE | 2u;
    if (!allowed_bits(m, address, value, 0x0E0F7FDFu)) return;
    if (s->cr & EN) {
        if ((value & EN) && ((s->cr ^ value) & ~own)) {
            fail(m, "%s: settings change while EN = 1", register_name(m, address));
            return;
        }
        s->cr = (s->cr & ~own) | (value & own); /* the rest is write-protected */
        if (!(value & EN)) { /* given up: TCIF tells so */
            s->has_ahead = false;
            raise_flag(m, n, stream, TCIF);
            if (n == 1) plan(m);
        }
        irq(m, n, stream);
        return;
    }
    s->cr = value;
    if (value & EN) enable(m, n, stream);
    irq(m, n, stream);
}

void dma_write(struct machine *m, unsigned n, uint32_t offset, uint32_t value) {
    struct dma *d = &m->dma[n];
    uint32_t address = 0x40026000u + 0x400u * n + offset;
    if (offset == 8 || offset == 12) {
        if (!allowed_bits(m, address, value, 0x0F7D0F7Du)) return;
        d->isr[(offset - 8) / 4] &= ~value;
        for (unsigned i = 0; i < STREAMS; i++) irq(m, n, i);
        return;
    }
    if (offset < 0x10 || offset >= 0x10 + 0x18 * STREAMS) {
        fail(m, "%s is not modelled", register_name(m, address));
        return;
    }
    unsigned stream = (offset - 0x10) / 0x18, which = (offset - 0x10) % 0x18;
    struct stream *s = &d->stream[stream];
    if (which == 0) {
        write_cr(m, n, stream, value);
        return;
    }
    bool other_target = (s->cr & DBM) && which == ((s->cr & CT) ? 0x0Cu : 0x10u);
    if ((s->cr & EN) && !other_target) {
        fail(m, "%s written while EN = 1", register_name(m, address));
        return;
    }
    switch (which) {
    case 0x04:
        if (allowed_bits(m, address, value, 0xFFFFu)) s->ndtr = value;
        break;
    case 0x08: s->par = value; break;
    case 0x0C: s->m0ar = value; break;
    case 0x10: s->m1ar = value; break;
    default:
        if (allowed_bits(m, address, value & ~0x38u, 0x07)) s->fcr = (value & 7u) | 0x20u;
    }
}
