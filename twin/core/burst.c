/* The two busy flows, many items at a time: link bytes and ADC samples, both moved by DMA.
 *
 * Does what spi_slave_event, tim_event and adc_event would do one by one, in the same order, as
 * long as nothing else is due, no flag or interrupt comes of it, and everything is as usual. What
 * is not is left to them. tests/twin compare both ways.
 */
#include <string.h>

#include "machine.h"

#define EN 1u

struct flow {
    uint64_t time; /* of the next item */
    uint32_t items; /* that may still be moved */
};

/* Items before a flag comes up. */
static uint32_t items_left(const struct stream *s) {
    uint32_t half = s->reload - s->reload / 2;
    return s->ndtr > half ? s->ndtr - half - 1 : s->ndtr - 1;
}

/* The memory of a stream in RAM, NULL if it is elsewhere. */
static uint8_t *ram_of(const struct machine *m, const struct stream *s, uint32_t size) {
    uint32_t base = (s->cr & (1u << 18)) && (s->cr & (1u << 19)) ? s->m1ar : s->m0ar;
    uint32_t offset = base - RAM_BASE;
    if (offset >= RAM_SIZE || s->reload * size > RAM_SIZE - offset) return NULL;
    return m->ram + offset;
}

/* EN, direction, MINC without PINC, sizes and channel 0. */
static bool is_usual(const struct stream *s, uint32_t direction, uint32_t size) {
    uint32_t want = EN | direction << 6 | 1u << 10 | (size / 2) << 11;
    return (s->cr & 0x0E001EC1u & ~0x100u) == want;
}

static uint32_t link_items(const struct machine *m) {
    const struct host *h = &m->host;
    const struct spi *s = &m->spi[0];
    const struct stream *rx = &m->dma[0].stream[3], *tx = &m->dma[0].stream[4];
    uint32_t line = 1u << (h->sck_pin % 16);
    if (!h->tx || h->chunk_bits != 8 || s->bits || h->next_bit % 8 || h->bits - h->next_bit < 16)
        return 0;
    if ((s->cr1 & 0x147u) != 0x40u || !s->tx_full || s->sr & 0x41u || s->cr2 != 3) return 0;
    if (!m->pin[h->sck_pin].link || !m->pin[h->miso_pin].link) return 0;
    if (((m->exti.rtsr | m->exti.ftsr) & ~m->exti.pr & line)) return 0;
    if (!is_usual(rx, 0, 1) || !is_usual(tx, 1, 1) || !tx->has_ahead) return 0;
    if (rx->port != 1 || tx->port != 1 || !ram_of(m, tx, 1) || !ram_of(m, rx, 1)) return 0;
    uint64_t left = (h->bits - h->next_bit) / 8 - 1;
    uint32_t items = items_left(rx) < items_left(tx) ? items_left(rx) : items_left(tx);
    return left < items ? (uint32_t)left : items;
}

/* The timer that paces the ADC, TIMERS if there is none. */
static unsigned pacer(const struct machine *m) {
    for (unsigned n = 0; n < TIMERS; n++)
        if (m->tim[n].paced) return n;
    return TIMERS;
}

static uint32_t sample_items(const struct machine *m, unsigned n) {
    const struct adc *a = &m->adc;
    const struct ccd *c = &m->ccd;
    const struct stream *s = &m->dma[1].stream[0];
    if (n == TIMERS || a->busy || (a->sr & 0x22u) || !a->period || a->dma_done) return 0;
    if ((a->cr2 & 0x903u) != 0x101u || (a->cr1 & 0x20u)) return 0;
    if (!is_usual(s, 0, 2) || s->port != 3 || !ram_of(m, s, 2)) return 0;
    if (!c->reading || !c->digitised || !c->icg || c->problems) return 0;
    return items_left(s);
}

static uint64_t others(const struct machine *m, unsigned n) {
    uint64_t next = NEVER;
    for (unsigned i = 0; i < EVENTS; i++)
        if (i != EVENT_SPI2 && i != EVENT_TIM + n && m->at[i] < next) next = m->at[i];
    return next;
}

/* Returns whether anything has been done. */
bool burst(struct machine *m, uint64_t until) {
    unsigned n = pacer(m);
    struct flow link = {NEVER, link_items(m)}, adc = {NEVER, sample_items(m, n)};
    if (!link.items && !adc.items) return false;
    uint64_t bound = others(m, adc.items ? n : EVENTS);
    if (bound > until) bound = until + 1;
    if (!link.items && m->at[EVENT_SPI2] < bound) bound = m->at[EVENT_SPI2];
    struct host *h = &m->host;
    struct spi *s = &m->spi[0];
    struct stream *rx = &m->dma[0].stream[3], *tx = &m->dma[0].stream[4];
    struct stream *samples = &m->dma[1].stream[0];
    uint8_t *to = ram_of(m, rx, 1), *from = ram_of(m, tx, 1), *elements = ram_of(m, samples, 2);
    const struct ccd *c = &m->ccd;
    uint64_t hold = 0, element = c->element;
    if (link.items) link.time = m->at[EVENT_SPI2];
    if (adc.items) {
        adc.time = m->at[EVENT_TIM + n] + m->adc.period;
        hold = m->at[EVENT_TIM + n] + m->adc.sampling;
    }
    uint64_t moved = 0, last = 0;
    for (;;) {
        if (adc.time < link.time) {
            if (adc.time >= bound || hold < c->icg_rise || hold >= c->end) break;
            uint16_t code = c->codes[(hold - c->icg_rise) / element];
            if (code > 4095) break;
            memcpy(elements + 2 * samples->index, &code, 2);
            samples->index++;
            samples->ndtr--;
            if (m->edges.size) {
                record(m, hold - m->adc.sampling, EDGE_SAMPLING, true);
                record(m, hold, EDGE_SAMPLING, false);
            }
            m->adc.dr = code;
            m->adc.hold = hold;
            last = adc.time;
            adc.time += m->tim[n].paced;
            hold += m->tim[n].paced;
            m->at[EVENT_TIM + n] += m->tim[n].paced;
            moved++;
            if (!--adc.items) break;
        } else {
            if (link.time >= bound) break;
            uint64_t byte = h->next_bit / 8;
            to[rx->index++] = s->received;
            rx->ndtr--;
            s->rx = s->received;
            s->shift = s->tx;
            s->tx = (uint8_t)tx->ahead;
            tx->index++;
            tx->ndtr--;
            tx->ahead = from[tx->index];
            s->received = h->tx[byte];
            h->rx[byte] = s->shift;
            h->chunk_start = h->next_bit;
            h->next_bit += 8;
            last = link.time;
            link.time = host_time(m, h->next_bit);
            m->at[EVENT_SPI2] = link.time;
            moved++;
            if (!--link.items) break;
        }
    }
    if (!moved) return false;
    if (last > m->now) m->now = last;
    return true;
}
