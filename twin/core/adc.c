/* ADC1: one regular channel, started by a timer's event or by software, read by DMA or CPU.
 *
 * A conversion holds the signal when its sampling time is over and ends 12 ADC clocks later.
 * What the pin carries is asked for at its end, for the moment of the hold.
 */
#include "machine.h"

#define EOC 2u
#define STRT 16u
#define OVR 32u
#define ADON 1u
#define CONT 2u
#define DMA 0x100u
#define DDS 0x200u
#define EOCS 0x400u
#define STABILISATION_TICKS (3u * (TICKS_PER_SECOND / 1000000u)) /* 3 us */
#define CONVERSION_CLOCKS 12u

static const uint16_t sampling_clocks[8] = {3, 15, 28, 56, 84, 112, 144, 480};

void adc_reset(struct machine *m) {
    m->adc = (struct adc){0};
    m->at[EVENT_ADC] = NEVER;
    irq_line(m, 18, false);
}

static uint64_t clock_of(const struct machine *m) {
    return (uint64_t)m->rcc.apb2 * 2 * (((m->adc.ccr >> 16) & 3) + 1);
}

static void irq(struct machine *m) {
    const struct adc *a = &m->adc;
    bool eoc = (a->sr & EOC) && (a->cr1 & 0x20u), ovr = (a->sr & OVR) && (a->cr1 & (1u << 26));
    irq_line(m, 18, eoc || ovr);
}

int adc_listens(const struct machine *m) {
    const struct adc *a = &m->adc;
    if (!(a->cr2 & ADON) || ((a->cr2 >> 28) & 3) != 1) return -1;
    return (int)((a->cr2 >> 24) & 15);
}

bool adc_requests(const struct machine *m) {
    return (m->adc.cr2 & DMA) && (m->adc.sr & EOC) && !m->adc.dma_done;
}

/* Channel of the only rank, -1 after a complaint. */
static int channel(struct machine *m) {
    const struct adc *a = &m->adc;
    unsigned n = a->sqr[2] & 31;
    if (a->sqr[0]) {
        fail(m, "ADC1_SQR1: more than one conversion is not modelled");
        return -1;
    }
    unsigned pin = n < 8 ? n : n < 10 ? 16 + n - 8 : n < 16 ? 32 + n - 10 : NO_PIN;
    if (pin == NO_PIN || m->config.role[pin] != ROLE_OS) {
        fail(m, "ADC1 converts channel %u, which is not wired", n);
        return -1;
    }
    if (((m->gpio[pin / 16].moder >> (2 * (pin % 16))) & 3) != 3) {
        fail(m, "ADC1 converts P%c%u, which is not in analog mode", (int)('A' + pin / 16), pin % 16);
        return -1;
    }
    return (int)n;
}

void adc_trigger(struct machine *m, uint64_t time) {
    struct adc *a = &m->adc;
    uint64_t clock = clock_of(m);
    if (a->busy || (a->sr & OVR)) return; /* lost */
    int n = channel(m);
    if (n < 0) return;
    if (time < a->on + STABILISATION_TICKS) {
        fail(m, "ADC1 started within 3 us of ADON");
        return;
    }
    if (TICKS_PER_SECOND / clock > 36000000u) {
        fail(m, "ADC1: its clock of %u kHz is above 36 MHz",
             (unsigned)(TICKS_PER_SECOND / clock / 1000));
        return;
    }
    unsigned sampling = (a->smpr[n < 10] >> (3 * (n % 10))) & 7;
    a->sampling = sampling_clocks[sampling] * clock;
    a->period = a->sampling + CONVERSION_CLOCKS * clock;
    a->hold = time + a->sampling;
    a->busy = true;
    a->sr |= STRT;
    if (m->edges.size) {
        record(m, time, EDGE_SAMPLING, true);
        record(m, a->hold, EDGE_SAMPLING, false);
    }
    machine_schedule(m, EVENT_ADC, time + a->period);
}

void adc_event(struct machine *m, uint64_t time) {
    struct adc *a = &m->adc;
    uint16_t code = ccd_sample(m, a->hold);
    a->busy = false;
    if ((a->sr & EOC) && (a->cr2 & (DMA | EOCS))) {
        a->sr |= OVR;
        irq(m);
        return;
    }
    if (code > 4095) fail(m, "the sensor gave code %u to a 12-bit ADC", code);
    a->dr = (a->cr2 & 0x800u) ? (uint32_t)code << 4 : code;
    a->sr |= EOC;
    if (adc_requests(m)) {
        dma_request(m, 1, 0, 0);
        if (a->sr & EOC) dma_request(m, 1, 4, 0);
    }
    irq(m);
    if (a->cr2 & CONT) adc_trigger(m, time);
}

uint32_t adc_read(struct machine *m, uint32_t offset) {
    struct adc *a = &m->adc;
    switch (offset) {
    case 0x00: return a->sr;
    case 0x04: return a->cr1;
    case 0x08: return a->cr2;
    case 0x0C: return a->smpr[0];
    case 0x10: return a->smpr[1];
    case 0x2C: return a->sqr[0];
    case 0x30: return a->sqr[1];
    case 0x34: return a->sqr[2];
    case 0x4C:
        a->sr &= ~EOC;
        irq(m);
        return a->dr;
    case 0x300: return a->sr & 0x3Fu;
    case 0x304: return a->ccr;
    default: break;
    }
    fail(m, "%s is not modelled", register_name(m, 0x40012000u + offset));
    return 0;
}

static void write_cr2(struct machine *m, uint32_t address, uint32_t value) {
    struct adc *a = &m->adc;
    if (!allowed_bits(m, address, value, 0x7F000F03u)) return;
    if (((value >> 28) & 3) > 1) fail(m, "%s: only rising edges are modelled",
                                      register_name(m, address));
    if (!(a->cr2 & ADON) && (value & ADON)) a->on = m->now;
    if ((a->cr2 & ADON) && !(value & ADON)) { /* stops and powers down */
        a->busy = false;
        m->at[EVENT_ADC] = NEVER;
    }
    if (!(a->cr2 & DMA) && (value & DMA)) a->dma_done = false;
    bool start = (value >> 30) & 1;
    a->cr2 = value & ~(1u << 30);
    if (start) {
        if (value & ADON)
            adc_trigger(m, m->now);
        else
            fail(m, "ADC1: SWSTART while ADON = 0");
    }
    tim_replan(m);
}

void adc_write(struct machine *m, uint32_t offset, uint32_t value) {
    struct adc *a = &m->adc;
    a->period = 0; /* the next start works it out */
    uint32_t address = 0x40012000u + offset;
    switch (offset) {
    case 0x00: a->sr &= value | ~0x3Fu; break;
    case 0x04:
        if (allowed_bits(m, address, value, 0x04000120u)) a->cr1 = value; /* OVRIE SCAN EOCIE */
        break;
    case 0x08: write_cr2(m, address, value); break;
    case 0x0C:
    case 0x10:
        if (allowed_bits(m, address, value, offset == 0x0C ? 0x07FFFFFFu : 0x3FFFFFFFu))
            a->smpr[(offset - 0x0C) / 4] = value;
        break;
    case 0x2C:
    case 0x30:
    case 0x34:
        if (allowed_bits(m, address, value, 0x3FFFFFFFu)) a->sqr[(offset - 0x2C) / 4] = value;
        break;
    case 0x304:
        if (allowed_bits(m, address, value, 0x00030000u)) a->ccr = value;
        break;
    default: fail(m, "%s is not modelled", register_name(m, address));
    }
    irq(m);
}
