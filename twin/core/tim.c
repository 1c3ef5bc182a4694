/* General purpose timers TIM2 to TIM5: up-counting, output compare, PWM, trigger mode.
 *
 * A running counter is not stepped. It is base_count at tick `base`, and one more every prescaler
 * period; what happened since `done` is worked out when somebody looks. Only what has an effect
 * elsewhere (an interrupt, a watched pin, a trigger) is scheduled as an event.
 */
#include "machine.h"

#define UIF 1u
#define UPDATE 1u /* bit 0 of an event set; compare channel n is bit 1 + n */
#define CEN 1u
#define URS 4u
#define OPM 8u
#define ARPE 0x80u
#define SMS_RESET 4u
#define SMS_TRIGGER 6u
#define TRIGGER_DELAY 2u /* clocks from a master's TRGO to the slave's counter: resynchronisation */

static const uint8_t irq_of[TIMERS] = {28, 29, 30, 50};
/* Master of ITR0 to ITR3 (RM0368, table of internal triggers); 0xFF: a timer that is not there. */
static const uint8_t itr[TIMERS][4] = {
    {0xFF, 0xFF, 1, 2}, {0xFF, 0, 3, 2}, {0xFF, 0, 1, 0xFF}, {0, 1, 2, 0xFF}};

static uint64_t limit(unsigned n) { return n == 0 || n == 3 ? 0xFFFFFFFFu : 0xFFFFu; }

static uint64_t tick_of(const struct machine *m, unsigned n) {
    return (uint64_t)(m->tim[n].psc_now + 1u) * m->rcc.timers;
}

static bool running(const struct tim *t) { return t->cr1 & CEN; }

bool tim_running(const struct machine *m) {
    for (unsigned n = 0; n < TIMERS; n++)
        if (running(&m->tim[n])) return true;
    return false;
}

static uint32_t mode_of(const struct tim *t, unsigned channel) {
    return (t->ccmr[channel / 2] >> (8 * (channel % 2) + 4)) & 7;
}

static uint64_t count_at(const struct machine *m, unsigned n, uint64_t time) {
    const struct tim *t = &m->tim[n];
    if (!running(t) || time <= t->base || !t->arr_now) return t->base_count;
    return t->base_count + (time - t->base) / tick_of(m, n);
}

static void irq(struct machine *m, unsigned n) {
    irq_line(m, irq_of[n], (m->tim[n].sr & m->tim[n].dier & 0x5Fu) != 0);
}

/* --- outputs -------------------------------------------------------------------------------- */
static bool level_of(const struct tim *t, unsigned channel, uint64_t count) {
    bool below = count < t->ccr_now[channel];
    switch (mode_of(t, channel)) {
    case 4: return false;
    case 5: return true;
    case 6: return below;
    case 7: return !below;
    default: return t->ref[channel];
    }
}

static bool output_of(const struct tim *t, unsigned channel, bool ref) {
    uint32_t bits = t->ccer >> (4 * channel);
    return (bits & 1) && ref != ((bits >> 1) & 1);
}

/* Level of a channel's output at `time`, not before what has been done. */
bool tim_output(struct machine *m, unsigned n, unsigned channel, uint64_t time) {
    const struct tim *t = &m->tim[n];
    uint64_t count = count_at(m, n, time);
    if (t->arr_now) count %= (uint64_t)t->arr_now + 1;
    return output_of(t, channel, level_of(t, channel, count));
}

uint64_t tim_period(const struct machine *m, unsigned n, unsigned channel) {
    const struct tim *t = &m->tim[n];
    if (!running(t) || !t->arr_now || !((t->ccer >> (4 * channel)) & 1)) return 0;
    if (mode_of(t, channel) < 6 || !t->ccr_now[channel] || t->ccr_now[channel] > t->arr_now)
        return 0;
    return ((uint64_t)t->arr_now + 1) * tick_of(m, n);
}

/* --- going on in time ------------------------------------------------------------------------ */
static void load_shadows(struct tim *t) {
    if (t->psc_now != t->psc || t->arr_now != t->arr) t->version++;
    t->psc_now = t->psc;
    t->arr_now = t->arr;
    for (unsigned i = 0; i < 4; i++) {
        if (t->ccr_now[i] != t->ccr[i]) t->version++;
        t->ccr_now[i] = t->ccr[i];
    }
}

static void matched(struct tim *t, unsigned channel) {
    uint32_t mode = mode_of(t, channel);
    t->sr |= 2u << channel;
    if (mode == 1) t->ref[channel] = 1;
    if (mode == 2) t->ref[channel] = 0;
    if (mode == 3) t->ref[channel] ^= 1;
}

static bool shadows_differ(const struct tim *t) {
    if (t->psc_now != t->psc || t->arr_now != t->arr) return true;
    for (unsigned i = 0; i < 4; i++)
        if (t->ccr_now[i] != t->ccr[i]) return true;
    return false;
}

/* Let everything up to `time` happen; what happened at exactly `time` is returned. */
static uint32_t advance(struct machine *m, unsigned n, uint64_t time) {
    struct tim *t = &m->tim[n];
    uint32_t at_time = 0;
    if (!running(t) || !t->arr_now || time <= t->done) return 0;
    for (;;) {
        uint64_t tick = tick_of(m, n);
        uint64_t over = t->base + ((uint64_t)t->arr_now + 1 - t->base_count) * tick;
        for (unsigned i = 0; i < 4; i++) {
            uint32_t ccr = t->ccr_now[i];
            if (ccr < t->base_count || ccr > t->arr_now) continue;
            uint64_t when = t->base + (uint64_t)(ccr - t->base_count) * tick;
            if (when <= t->done || when > time) continue;
            matched(t, i);
            if (when == time) at_time |= 2u << i;
        }
        if (over > time) break;
        if (t->base_count > t->arr_now) {
            fail(m, "TIM%u: counter beyond ARR", n + 2);
            break;
        }
        t->sr |= UIF;
        load_shadows(t);
        t->base = over;
        t->base_count = 0;
        t->done = over;
        at_time = over == time ? UPDATE : 0;
        for (unsigned i = 0; i < 4; i++)
            if (t->ccr_now[i] == 0) {
                matched(t, i);
                if (over == time) at_time |= 2u << i;
            }
        if (t->cr1 & OPM) {
            t->cr1 &= ~CEN;
            t->phase = 0;
            t->version++;
            return at_time;
        }
        uint64_t period = ((uint64_t)t->arr_now + 1) * tick_of(m, n);
        if (time - over > 2 * period && !shadows_differ(t)) { /* unobserved: skip whole periods */
            for (unsigned i = 0; i < 4; i++)
                if (t->ccr_now[i] <= t->arr_now) {
                    if (mode_of(t, i) == 3)
                        fail(m, "TIM%u: toggling on an unconnected channel is not modelled", n + 2);
                    matched(t, i);
                }
            t->base += (time - over) / period * period - period;
            t->done = t->base;
        }
    }
    t->done = time;
    return at_time;
}

static bool waits_for(const struct machine *m, unsigned slave, unsigned master) {
    const struct tim *s = &m->tim[slave];
    uint32_t source = (s->smcr >> 4) & 7;
    uint32_t mode = s->smcr & 7;
    bool listens = (mode == SMS_TRIGGER && !running(s)) || (mode == SMS_RESET && running(s));
    return listens && source < 4 && itr[slave][source] == master;
}

static int adc_source(unsigned n, unsigned channel) {
    static const int8_t code[TIMERS][4] = {
        {-1, 3, 4, 5}, {7, -1, -1, -1}, {-1, -1, -1, 9}, {10, 11, 12, -1}};
    return code[n][channel];
}

static int adc_trgo(unsigned n) { return n == 0 ? 6 : n == 1 ? 8 : -1; }

static bool trgo_wanted(const struct machine *m, unsigned n) {
    for (unsigned s = 0; s < TIMERS; s++)
        if (waits_for(m, s, n)) return true;
    return adc_trgo(n) >= 0 && adc_listens(m) == adc_trgo(n);
}

static uint32_t edges_of(const struct tim *t, unsigned channel, bool rising_only) {
    uint32_t mode = mode_of(t, channel), match = 2u << channel;
    if (rising_only && t->ccr_now[channel] && !shadows_differ(t)) {
        if (mode == 7) return match;
        if (mode == 6) return UPDATE;
    }
    return match | UPDATE;
}

/* What of this timer must happen on time? */
static uint32_t wanted(const struct machine *m, unsigned n) {
    const struct tim *t = &m->tim[n];
    uint32_t events = t->dier & 0x1Fu, master = (t->cr2 >> 4) & 7;
    if (t->cr1 & OPM) events |= UPDATE;
    for (unsigned i = 0; i < 4; i++) {
        for (unsigned j = 0; j < 2; j++)
            if (t->pins[i][j] != NO_PIN && pin_observed(m, t->pins[i][j]))
                events |= edges_of(t, i, false);
        if (adc_source(n, i) >= 0 && adc_listens(m) == adc_source(n, i))
            events |= edges_of(t, i, true);
    }
    if (master >= 2 && trgo_wanted(m, n)) {
        if (master == 2) events |= UPDATE;
        if (master == 3) events |= 2u;
        if (master >= 4) events |= edges_of(t, master - 4, true);
    }
    return events;
}

static void plan(struct machine *m, unsigned n) {
    struct tim *t = &m->tim[n];
    uint64_t next = NEVER;
    if (running(t) && t->arr_now && t->events) {
        uint64_t tick = tick_of(m, n);
        if (t->base_count > t->arr_now) fail(m, "TIM%u: counter beyond ARR", n + 2);
        uint64_t over = t->base + ((uint64_t)t->arr_now + 1 - t->base_count) * tick;
        bool after = false; /* all its compares of this period are over */
        for (unsigned i = 0; i < 4; i++) {
            if (!(t->events & (2u << i)) || t->ccr_now[i] > t->arr_now) continue;
            uint64_t when = NEVER;
            if (t->ccr_now[i] >= t->base_count)
                when = t->base + (uint64_t)(t->ccr_now[i] - t->base_count) * tick;
            if (when == NEVER || when <= t->done)
                after = true;
            else if (when < next)
                next = when;
        }
        /* preloaded values may bring events that are not wanted yet */
        if (((t->events & UPDATE) || after || shadows_differ(t)) && over < next) next = over;
    }
    machine_schedule(m, EVENT_TIM + n, next);
}

/* Decide anew what has to happen when. */
static void decide(struct machine *m, unsigned n) {
    struct tim *t = &m->tim[n];
    t->events = wanted(m, n);
    t->paced = 0;
    for (unsigned i = 0; i < 4; i++)
        if (t->events == (2u << i) && mode_of(t, i) == 7 && adc_source(n, i) >= 0 &&
            adc_listens(m) == adc_source(n, i) && !(t->dier & 0x1Fu) && !shadows_differ(t) &&
            ((t->ccer >> (4 * i)) & 1) && t->ccr_now[i] && t->ccr_now[i] <= t->arr_now)
            t->paced = ((uint64_t)t->arr_now + 1) * tick_of(m, n);
    plan(m, n);
}

static void start(struct machine *m, unsigned n, uint64_t time) {
    struct tim *t = &m->tim[n];
    t->cr1 |= CEN;
    t->base = time - t->phase;
    t->done = time;
    t->version++;
}

static void stop(struct machine *m, unsigned n, uint64_t time) {
    struct tim *t = &m->tim[n];
    t->phase = time > t->base ? (time - t->base) % tick_of(m, n) : 0;
    t->base_count = (uint32_t)count_at(m, n, time);
    t->cr1 &= ~CEN;
    t->version++;
}

/* Reset mode: an update event, and the counter from 0. */
static void begin_anew(struct machine *m, unsigned n, uint64_t time) {
    struct tim *t = &m->tim[n];
    advance(m, n, time);
    if (!(t->cr1 & URS)) t->sr |= UIF;
    load_shadows(t);
    t->base_count = 0;
    t->phase = 0;
    t->base = t->done = time + TRIGGER_DELAY * m->rcc.timers;
    for (unsigned i = 0; i < 4; i++)
        if (mode_of(t, i) >= 6) t->ref[i] = level_of(t, i, 0);
    t->version++;
}

/* The trigger output rises. */
static void trgo(struct machine *m, unsigned n, uint64_t time) {
    if (adc_trgo(n) >= 0 && adc_listens(m) == adc_trgo(n)) adc_trigger(m, time);
    for (unsigned s = 0; s < TIMERS; s++) {
        if (!waits_for(m, s, n)) continue;
        m->tim[s].sr |= 0x40u;
        if (running(&m->tim[s]))
            begin_anew(m, s, time);
        else
            start(m, s, time + TRIGGER_DELAY * m->rcc.timers);
        irq(m, s);
        if (((m->tim[s].cr2 >> 4) & 7) == 1) trgo(m, s, time);
        decide(m, s);
    }
}

/* Outputs as they are now; edges have their effects. */
static void show(struct machine *m, unsigned n, uint64_t time) {
    struct tim *t = &m->tim[n];
    uint32_t master = (t->cr2 >> 4) & 7;
    uint64_t count = count_at(m, n, time);
    for (unsigned i = 0; i < 4; i++) {
        bool before = t->ref[i], now = level_of(t, i, count);
        bool output = output_of(t, i, now);
        t->ref[i] = now;
        if (!before && now) {
            if (master == 4 + i) trgo(m, n, time);
            if (adc_source(n, i) >= 0 && adc_listens(m) == adc_source(n, i)) {
                if (!((t->ccer >> (4 * i)) & 1))
                    fail(m, "ADC triggered by TIM%u_CC%u, whose output CCxE disables", n + 2, i + 1);
                adc_trigger(m, time);
            }
        }
        for (unsigned j = 0; j < 2; j++)
            if (t->pins[i][j] != NO_PIN) pin_set(m, t->pins[i][j], output, time);
    }
}

void tim_event(struct machine *m, unsigned n, uint64_t time) {
    struct tim *t = &m->tim[n];
    if (t->paced) { /* its registers are brought up to date when somebody looks */
        adc_trigger(m, time);
        machine_schedule(m, EVENT_TIM + n, time + t->paced);
        return;
    }
    uint32_t happened = advance(m, n, time), master = (t->cr2 >> 4) & 7;
    uint32_t version = t->version;
    show(m, n, time);
    if (((happened & UPDATE) && master == 2) || ((happened & 2u) && master == 3)) trgo(m, n, time);
    if (t->sr & t->dier) irq(m, n);
    if (version != t->version)
        decide(m, n);
    else
        plan(m, n);
}

/* Bring a timer that nobody observed up to now; nothing depended on it. */
static void catch_up(struct machine *m, unsigned n) {
    struct tim *t = &m->tim[n];
    (void)advance(m, n, m->now);
    for (unsigned i = 0; i < 4; i++) t->ref[i] = level_of(t, i, count_at(m, n, m->now));
}

/* Something that decides which events matter has changed. */
void tim_replan(struct machine *m) {
    for (unsigned n = 0; n < TIMERS; n++) {
        if (!running(&m->tim[n])) continue;
        catch_up(m, n);
        decide(m, n);
    }
}

/* --- registers ------------------------------------------------------------------------------ */
void tim_reset(struct machine *m, unsigned n) {
    struct tim old = m->tim[n];
    struct tim *t = &m->tim[n];
    *t = (struct tim){.arr = (uint32_t)limit(n), .arr_now = (uint32_t)limit(n)};
    t->version = old.version + 1;
    for (unsigned i = 0; i < 4; i++)
        for (unsigned j = 0; j < 2; j++)
            t->pins[i][j] = old.version ? old.pins[i][j] : NO_PIN;
    m->at[EVENT_TIM + n] = NEVER;
    irq_line(m, irq_of[n], false);
    if (m->rcc.cpu) show(m, n, m->now);
}

uint32_t tim_read(struct machine *m, unsigned n, uint32_t offset) {
    struct tim *t = &m->tim[n];
    (void)advance(m, n, m->now);
    switch (offset) {
    case 0x00: return t->cr1;
    case 0x04: return t->cr2;
    case 0x08: return t->smcr;
    case 0x0C: return t->dier;
    case 0x10: return t->sr;
    case 0x14: return 0;
    case 0x18: return t->ccmr[0];
    case 0x1C: return t->ccmr[1];
    case 0x20: return t->ccer;
    case 0x24: return (uint32_t)count_at(m, n, m->now);
    case 0x28: return t->psc;
    case 0x2C: return t->arr;
    case 0x34: case 0x38: case 0x3C: case 0x40: return t->ccr[(offset - 0x34) / 4];
    default: break;
    }
    fail(m, "%s is not modelled", register_name(m, PERIPHERALS + 0x400u * n + offset));
    return 0;
}

static void set_count(struct machine *m, unsigned n, uint32_t count, bool restart_prescaler) {
    struct tim *t = &m->tim[n];
    uint64_t phase = t->phase;
    if (running(t))
        phase = m->now > t->base ? (m->now - t->base) % tick_of(m, n) : 0;
    if (restart_prescaler) phase = 0;
    t->base_count = count;
    t->phase = phase;
    if (running(t)) {
        bool started = m->now >= t->base;
        if (started) t->base = m->now - phase;
        t->done = m->now;
    }
    t->version++;
}

static void write_cr1(struct machine *m, unsigned n, uint32_t address, uint32_t value) {
    struct tim *t = &m->tim[n];
    if (!allowed_bits(m, address, value, CEN | URS | OPM | ARPE)) return;
    bool was = running(t), on = value & CEN;
    if (was && !on) stop(m, n, m->now);
    t->cr1 = (value & ~CEN) | (t->cr1 & CEN);
    if (!(value & ARPE) && t->arr_now != t->arr) {
        t->arr_now = t->arr;
        t->version++;
    }
    if (!was && on) {
        start(m, n, m->now + m->rcc.timers);
        if (((t->cr2 >> 4) & 7) == 1) trgo(m, n, m->now);
    }
}

static void generate_update(struct machine *m, unsigned n, uint32_t address, uint32_t value) {
    struct tim *t = &m->tim[n];
    uint32_t master = (t->cr2 >> 4) & 7;
    if (!allowed_bits(m, address, value, 0x1F)) return;
    t->sr |= value & 0x1Eu;
    if (!(value & 1)) return;
    if (!(t->cr1 & URS)) t->sr |= UIF;
    load_shadows(t);
    set_count(m, n, 0, true);
    if (master == 0 || master == 2) trgo(m, n, m->now);
}

void tim_write(struct machine *m, unsigned n, uint32_t offset, uint32_t value) {
    struct tim *t = &m->tim[n];
    uint32_t address = PERIPHERALS + 0x400u * n + offset;
    for (unsigned i = 0; i < TIMERS; i++) catch_up(m, i);
    switch (offset) {
    case 0x00: write_cr1(m, n, address, value); break;
    case 0x04:
        if (allowed_bits(m, address, value, 0x70)) t->cr2 = value;
        break;
    case 0x08:
        if (!allowed_bits(m, address, value, 0x77)) break;
        if ((value & 7) && (((value & 7) != SMS_TRIGGER && (value & 7) != SMS_RESET) ||
                            (value & 0x40) || itr[n][(value >> 4) & 3] == 0xFF))
            fail(m, "%s = 0x%X: only trigger and reset mode from ITRx are modelled",
                 register_name(m, address), value);
        t->smcr = value;
        break;
    case 0x0C:
        if (allowed_bits(m, address, value, 0x5F)) t->dier = value;
        break;
    case 0x10: t->sr &= value; break;
    case 0x14: generate_update(m, n, address, value); break;
    case 0x18:
    case 0x1C:
        if (!allowed_bits(m, address, value, 0x7878)) break;
        t->ccmr[(offset - 0x18) / 4] = value;
        t->version++;
        break;
    case 0x20:
        if (!allowed_bits(m, address, value, 0x3333)) break;
        t->ccer = value;
        t->version++;
        break;
    case 0x24:
        if (value > limit(n)) fail(m, "%s is 16 bits wide", register_name(m, address));
        set_count(m, n, value, false);
        break;
    case 0x28:
        if (allowed_bits(m, address, value, 0xFFFFu)) t->psc = value;
        break;
    case 0x2C:
        if (!allowed_bits(m, address, value, (uint32_t)limit(n))) break;
        t->arr = value;
        if (!(t->cr1 & ARPE)) {
            if (running(t) && count_at(m, n, m->now) > value)
                fail(m, "%s: below the counter, which would run to its end",
                     register_name(m, address));
            t->arr_now = value;
            t->version++;
        }
        break;
    case 0x34: case 0x38: case 0x3C: case 0x40: {
        unsigned i = (offset - 0x34) / 4;
        if (!allowed_bits(m, address, value, (uint32_t)limit(n))) break;
        t->ccr[i] = value;
        if (!((t->ccmr[i / 2] >> (8 * (i % 2) + 3)) & 1)) {
            t->ccr_now[i] = value;
            t->version++;
        }
        break;
    }
    default:
        fail(m, "%s is not modelled", register_name(m, address));
    }
    for (unsigned i = 0; i < TIMERS; i++) {
        decide(m, i);
    }
    show(m, n, m->now);
    irq(m, n);
}
