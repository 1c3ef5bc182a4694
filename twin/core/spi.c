/* SPI2, slave on the link to the host; SPI3, master of the chain of 74HC595.
 *
 * A slave's byte goes from the transmit buffer to the shift register at its first clock, so one
 * byte is always fetched ahead; a byte that nobody has read when the next one is complete sets
 * OVR, and the newer one is lost. Bits are counted: a slave that is enabled while the host clocks
 * starts in the middle of the host's byte and stays shifted.
 */
#include "machine.h"

#define CPHA 1u
#define CPOL 2u
#define MSTR 4u
#define SPE 0x40u
#define SSI 0x100u
#define SSM 0x200u
#define RXNE 1u
#define TXE 2u
#define OVR 0x40u
#define BSY 0x80u
#define RXDMAEN 1u
#define TXDMAEN 2u
#define ERRIE 0x20u
#define RXNEIE 0x40u
#define TXEIE 0x80u

static const uint8_t irq_of[2] = {36, 51};

static uint32_t status(const struct machine *m, unsigned n) {
    const struct spi *s = &m->spi[n];
    return s->sr | (s->tx_full ? 0 : TXE);
}

static void irq(struct machine *m, unsigned n) {
    uint32_t sr = status(m, n), cr2 = m->spi[n].cr2;
    irq_line(m, irq_of[n], ((sr & TXE) && (cr2 & TXEIE)) || ((sr & RXNE) && (cr2 & RXNEIE)) ||
                               ((sr & OVR) && (cr2 & ERRIE)));
}

bool spi_requests_tx(const struct machine *m, unsigned n) {
    return (m->spi[n].cr2 & TXDMAEN) && !m->spi[n].tx_full;
}

bool spi_requests_rx(const struct machine *m, unsigned n) {
    return (m->spi[n].cr2 & RXDMAEN) && (m->spi[n].sr & RXNE);
}

void spi_requests(struct machine *m, unsigned n) {
    if (spi_requests_rx(m, n)) {
        dma_request(m, 0, n ? 0 : 3, 0);
        if (n && spi_requests_rx(m, n)) dma_request(m, 0, 2, 0);
    }
    if (spi_requests_tx(m, n)) {
        dma_request(m, 0, n ? 5 : 4, 0);
        if (n && spi_requests_tx(m, n)) dma_request(m, 0, 7, 0);
    }
    irq(m, n);
}

static void receive(struct machine *m, unsigned n, uint8_t byte) {
    struct spi *s = &m->spi[n];
    if (s->sr & RXNE) {
        s->sr |= OVR;
        s->ovr_read = false;
    } else {
        s->rx = byte;
        s->sr |= RXNE;
    }
}

static void load(struct machine *m, unsigned n) {
    struct spi *s = &m->spi[n];
    if (!s->tx_full && n == 0 && (s->cr2 & TXDMAEN)) m->host.underruns++;
    s->shift = s->tx; /* with nothing new, the last byte again */
    s->tx_full = false;
    s->sr |= BSY;
}

/* --- the host's clock ------------------------------------------------------------------------ */
static unsigned find_role(const struct machine *m, unsigned role) {
    for (unsigned i = 0; i < PINS; i++)
        if (m->config.role[i] == role) return i;
    return 0; /* a pin that is never a link */
}

uint64_t host_time(const struct machine *m, uint64_t bit) {
    return m->host.start + bit * TICKS_PER_SECOND / m->host.hertz;
}

/* Does the slave see the clock? */
static bool listening(const struct machine *m) {
    const struct spi *s = &m->spi[0];
    return (s->cr1 & (SPE | MSTR)) == SPE && !(s->cr1 & SSI) &&
           m->pin[m->host.sck_pin].link;
}

void host_start(struct machine *m) {
    if (m->edges.size) {
        bool gap = m->host.start > m->host.record_end + TICKS_PER_SECOND / 1000000u;
        if (m->host.record_end && gap) record(m, m->host.record_end, EDGE_LINK, false);
        if (!m->host.record_end || gap) record(m, m->host.start, EDGE_LINK, true);
        m->host.record_end = host_time(m, m->host.bits);
    }
    m->host.sck_pin = (uint8_t)find_role(m, ROLE_SCK);
    m->host.miso_pin = (uint8_t)find_role(m, ROLE_MISO);
    m->host.chunk_bits = 0;
    machine_schedule(m, EVENT_SPI2, m->host.start);
}

/* The bits of a chunk, most significant first, right-aligned. */
static uint8_t host_bits(const struct host *h, uint64_t first, unsigned count) {
    uint32_t pair = (uint32_t)h->tx[first / 8] << 8;
    if (first / 8 + 1 < h->bits / 8) pair |= h->tx[first / 8 + 1];
    return (uint8_t)((pair >> (16 - first % 8 - count)) & ((1u << count) - 1u));
}

static void miso(struct machine *m, uint64_t first, unsigned count, uint8_t bits) {
    struct host *h = &m->host;
    if (!m->pin[h->miso_pin].link) return;
    uint32_t pair = (uint32_t)bits << (16 - first % 8 - count);
    h->rx[first / 8] |= (uint8_t)(pair >> 8);
    if (first / 8 + 1 < h->bits / 8) h->rx[first / 8 + 1] |= (uint8_t)(pair & 0xFFu);
}

void spi_slave_event(struct machine *m, uint64_t time) {
    struct host *h = &m->host;
    struct spi *s = &m->spi[0];
    if (!h->tx) return;
    if (h->chunk_bits) { /* has been shifted */
        s->bits += (uint32_t)h->chunk_bits;
        h->chunk_bits = 0;
        if (s->bits == 8) {
            s->bits = 0;
            s->sr &= ~BSY;
            receive(m, 0, s->received);
            spi_requests(m, 0);
        }
    }
    if (h->next_bit >= h->bits || m->failed) return;
    uint64_t first = h->next_bit;
    unsigned count = 8 - (unsigned)(first % 8);
    exti_edge(m, h->sck_pin, true, true);
    if (listening(m)) {
        if (s->cr1 & (CPHA | CPOL)) {
            fail(m, "SPI2_CR1: the host clocks in mode 0");
            return;
        }
        if (s->bits == 0) {
            load(m, 0);
            spi_requests(m, 0);
        }
        count = 8 - s->bits;
        if (count > h->bits - first) count = (unsigned)(h->bits - first);
        uint32_t out = (uint32_t)s->shift << s->bits & 0xFFu;
        miso(m, first, count, (uint8_t)(out >> (8 - count)));
        s->received = (uint8_t)((uint32_t)s->received << count | host_bits(h, first, count));
        h->chunk_bits = count;
        h->chunk_start = first;
    }
    h->next_bit = first + count;
    uint64_t next = host_time(m, h->next_bit);
    if (h->next_bit == h->bits) next -= TICKS_PER_SECOND / h->hertz / 2; /* sampled in its middle */
    machine_schedule(m, EVENT_SPI2, next > time ? next : time + 1);
}

/* The slave appears or disappears while the host clocks. */
static void interrupt_host(struct machine *m) {
    struct host *h = &m->host;
    if (!h->tx) return;
    uint64_t gone = m->now > h->start ? m->now - h->start : 0;
    uint64_t bit = gone * h->hertz / TICKS_PER_SECOND + 1; /* the next one to come */
    if (bit > h->bits) bit = h->bits;
    if (h->chunk_bits) { /* what it would have said from here on */
        for (uint64_t b = bit; b < h->chunk_start + h->chunk_bits; b++)
            h->rx[b / 8] &= (uint8_t)~(0x80u >> (b % 8));
        h->chunk_bits = 0;
    }
    h->next_bit = bit;
    machine_schedule(m, EVENT_SPI2, host_time(m, bit) > m->now ? host_time(m, bit) : m->now + 1);
}

/* --- the chain ------------------------------------------------------------------------------ */
static void chain_lights(struct machine *m, uint64_t time) {
    struct chain *c = &m->chain;
    unsigned first = m->config.chain_first;
    for (unsigned i = 0; i + first < LEDS; i++)
        ccd_light(m, i + first, c->enabled && ((c->latched >> i) & 1), time);
}

void chain_pin(struct machine *m, unsigned role, bool level, uint64_t time) {
    struct chain *c = &m->chain;
    if (role == ROLE_CHAIN_ENABLE) {
        if (c->enabled == !level) return;
        c->enabled = !level;
    } else if (level) {
        if (m->spi[1].sr & BSY) {
            fail(m, "the chain's latch rises while SPI3 shifts");
            return;
        }
        c->latched = c->shifted;
    } else {
        return;
    }
    chain_lights(m, time);
}

static bool chain_wired(const struct machine *m) {
    return m->pin[find_role(m, ROLE_CHAIN_CLOCK)].link &&
           m->pin[find_role(m, ROLE_CHAIN_DATA)].link;
}

static void master_start(struct machine *m, unsigned n, uint64_t time) {
    struct spi *s = &m->spi[n];
    uint64_t bit = (uint64_t)m->rcc.apb1 << (((s->cr1 >> 3) & 7) + 1);
    load(m, n);
    machine_schedule(m, EVENT_SPI3, time + 8 * bit);
    spi_requests(m, n);
}

void spi_master_event(struct machine *m, uint64_t time) {
    struct spi *s = &m->spi[1];
    s->sr &= ~BSY;
    if (chain_wired(m)) m->chain.shifted = m->chain.shifted << 8 | s->shift;
    receive(m, 1, 0);
    if (s->tx_full)
        master_start(m, 1, time);
    spi_requests(m, 1);
}

/* --- registers ------------------------------------------------------------------------------ */
void spi_reset(struct machine *m, unsigned n) {
    m->spi[n] = (struct spi){0};
    m->at[n ? EVENT_SPI3 : EVENT_SPI2] = NEVER;
    irq_line(m, irq_of[n], false);
    if (n == 0) interrupt_host(m);
}

uint32_t spi_read(struct machine *m, unsigned n, uint32_t offset) {
    struct spi *s = &m->spi[n];
    uint32_t value;
    switch (offset) {
    case 0x00: return s->cr1;
    case 0x04: return s->cr2;
    case 0x08:
        value = status(m, n);
        if (s->ovr_read) {
            s->sr &= ~OVR;
            s->ovr_read = false;
            irq(m, n);
        }
        return value;
    case 0x0C:
        s->sr &= ~RXNE;
        if (s->sr & OVR) s->ovr_read = true;
        irq(m, n);
        return s->rx;
    case 0x1C: return 0;
    default: break;
    }
    fail(m, "%s is not modelled", register_name(m, 0x40003800u + 0x400u * n + offset));
    return 0;
}

static void write_cr1(struct machine *m, unsigned n, uint32_t address, uint32_t value) {
    struct spi *s = &m->spi[n];
    uint32_t before = s->cr1;
    if (!allowed_bits(m, address, value, 0x37Fu)) return;
    if ((before & value & SPE) && ((before ^ value) & ~(SSI | SPE)))
        fail(m, "%s: settings change while SPE = 1", register_name(m, address));
    s->cr1 = value;
    if (value & SPE) {
        if (!(value & SSM)) fail(m, "%s: the NSS pin is not modelled", register_name(m, address));
        if (n == 0 && (value & MSTR)) fail(m, "SPI2 as master is not modelled");
        if (n == 1 && !(value & MSTR)) fail(m, "SPI3 as slave is not modelled");
        if ((value & MSTR) && !(value & SSI)) fail(m, "%s: master with SSI = 0: MODF",
                                                   register_name(m, address));
        if (n == 1 && ((value ^ value >> 1) & 1))
            fail(m, "SPI3_CR1: the 74HC595 shifts on the rising edge: CPOL must equal CPHA");
    }
    if (!((before ^ value) & (SPE | SSI))) return;
    if (n == 0) {
        if (!(value & SPE)) {
            s->bits = 0;
            s->sr &= ~BSY;
        }
        interrupt_host(m);
    } else if (value & SPE) {
        if (s->tx_full) master_start(m, n, m->now);
    } else if (s->sr & BSY) {
        fail(m, "SPI3 switched off while it shifts");
    }
}

void spi_write(struct machine *m, unsigned n, uint32_t offset, uint32_t value) {
    struct spi *s = &m->spi[n];
    uint32_t address = 0x40003800u + 0x400u * n + offset;
    switch (offset) {
    case 0x00: write_cr1(m, n, address, value); break;
    case 0x04:
        if (!allowed_bits(m, address, value, 0xE7u)) break;
        s->cr2 = value;
        spi_requests(m, n);
        break;
    case 0x08:
        if (!allowed_bits(m, address, value & ~0xFFu, 0)) break;
        break; /* no flag of it is modelled that a write clears */
    case 0x0C:
        s->tx = (uint8_t)value;
        s->tx_full = true;
        if (n == 1 && (s->cr1 & SPE) && !(s->sr & BSY)) master_start(m, n, m->now);
        irq(m, n);
        break;
    case 0x1C:
        (void)allowed_bits(m, address, value, 0);
        break;
    default: fail(m, "%s is not modelled", register_name(m, address));
    }
}
