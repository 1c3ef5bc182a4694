/* TCD1304: charge, read-out and the datasheet's limits, driven by the levels of its pins.
 *
 * The charge of a pixel is a sum over the sources of light, each with its own rate and its own
 * time lit, and a residue. As all of it is linear, each SH pulse only scales the 65 weights (it
 * takes the fraction R of the charge and leaves 1 - R: image lag R(1 - R)^(N - 1)). Pixels are
 * worked out one by one when they are read, or when one may have reached the full well.
 */
#include <string.h>

#include "machine.h"

#define MICROSECOND (TICKS_PER_SECOND / 1000000u)
#define NANOSECONDS(t) ((uint64_t)(t) * (TICKS_PER_SECOND / 1000000u) / 1000u)
#define NEGLIGIBLE 1e-9 /* electrons */
#define VIOLATIONS_KEPT 4096u
#define LAST_PIXEL 3680u /* element after it; what follows is dummy */

static double seconds(uint64_t ticks) { return (double)ticks / TICKS_PER_SECOND; }

void ccd_reset(struct machine *m) {
    struct ccd *c = &m->ccd;
    memset(c, 0, sizeof *c);
    c->residue_scale = 1.0;
    c->fm_pin = NO_PIN;
    c->sh = c->icg = m->config.inverted != 0; /* the pins are low */
    for (unsigned i = 0; i <= ELEMENTS; i++) c->codes[i] = m->config.idle_code;
    for (unsigned i = 0; i < PINS; i++)
        if (m->config.role[i] == ROLE_FM) c->fm_pin = (uint8_t)i;
    m->chain = (struct chain){0};
}

static bool call_failed(struct machine *m) {
    if (!m->failed) m->callback_failed = true;
    fail(m, "a callback failed");
    return false;
}

static void violation(struct machine *m, uint32_t problem, double value, uint64_t time) {
    struct violation v = {.time = time, .value = value, .kind = problem};
    if (m->violations.count < VIOLATIONS_KEPT) log_add(m, &m->violations, &v);
}

/* --- charge --------------------------------------------------------------------------------- */
static double row_max(struct machine *m, unsigned source) {
    struct ccd *c = &m->ccd;
    uint64_t bit = (uint64_t)1 << (source % 64);
    if (!(c->row_known[source / 64] & bit)) {
        const double *rate = m->config.rates + (size_t)source * PIXELS;
        double max = 0.0;
        for (unsigned j = 0; j < PIXELS; j++)
            if (rate[j] > max) max = rate[j];
        c->row_max[source] = max;
        c->row_known[source / 64] |= bit;
    }
    return c->row_max[source];
}

static void add_row(double *charge, const double *rate, double weight) {
    for (unsigned j = 0; j < PIXELS; j++) charge[j] += weight * rate[j];
}

/* Close the lit times at `time`. */
static void count_light(struct machine *m, uint64_t time) {
    struct ccd *c = &m->ccd;
    c->on[0] += time - c->since[0];
    c->since[0] = time;
    for (uint64_t set = c->lit; set; set &= set - 1) {
        unsigned k = 1u + (unsigned)__builtin_ctzll(set);
        c->on[k] += time - c->since[k];
        c->since[k] = time;
    }
}

/* Turn the lit times that are not charge yet into weights. */
static void weigh(struct ccd *c) {
    c->weight[0] += seconds(c->on[0] - c->counted[0]);
    c->counted[0] = c->on[0];
    for (uint64_t set = c->weighted; set; set &= set - 1) {
        unsigned k = 1u + (unsigned)__builtin_ctzll(set);
        c->weight[k] += seconds(c->on[k] - c->counted[k]);
        c->counted[k] = c->on[k];
    }
}

/* Charge as vector: weights become zero. */
static void fold(struct machine *m, double clip) {
    struct ccd *c = &m->ccd;
    double max = 0.0;
    for (unsigned j = 0; j < PIXELS; j++) c->residue[j] *= c->residue_scale;
    add_row(c->residue, m->config.rates, c->weight[0]);
    c->weight[0] = 0.0;
    for (uint64_t set = c->weighted; set; set &= set - 1) {
        unsigned k = 1u + (unsigned)__builtin_ctzll(set);
        if (c->weight[k] != 0.0)
            add_row(c->residue, m->config.rates + (size_t)k * PIXELS, c->weight[k]);
        c->weight[k] = 0.0;
    }
    for (unsigned j = 0; j < PIXELS; j++) {
        if (c->residue[j] > clip) c->residue[j] = clip;
        if (c->residue[j] > max) max = c->residue[j];
    }
    c->residue_scale = 1.0;
    c->residue_max = max;
}

static double bound(struct machine *m) {
    const struct ccd *c = &m->ccd;
    double sum = c->residue_scale * c->residue_max + c->weight[0] * row_max(m, 0);
    for (uint64_t set = c->weighted; set; set &= set - 1) {
        unsigned k = 1u + (unsigned)__builtin_ctzll(set);
        if (c->weight[k] != 0.0) sum += c->weight[k] * row_max(m, k);
    }
    return sum;
}

/* The fraction that SH took, as vector. */
static void out_charge(const struct machine *m, double *charge) {
    const struct ccd *c = &m->ccd;
    for (unsigned j = 0; j < PIXELS; j++)
        charge[j] = c->out_has_residue ? c->out_scale * c->out_residue[j] : 0.0;
    for (unsigned k = 0; k < SOURCES; k++)
        if (c->out_weight[k] != 0.0)
            add_row(charge, m->config.rates + (size_t)k * PIXELS, c->out_weight[k]);
}

/* The rates are about to change: what they have done so far must not. */
static void fold_all(struct machine *m, uint64_t time) {
    struct ccd *c = &m->ccd;
    count_light(m, time);
    weigh(c);
    fold(m, bound(m) > m->config.full_well ? m->config.full_well : 1e300);
    if (c->out_time && !c->digitised) {
        double charge[PIXELS];
        out_charge(m, charge);
        memcpy(c->out_residue, charge, sizeof charge);
        memset(c->out_weight, 0, sizeof c->out_weight);
        c->out_scale = 1.0;
        c->out_has_residue = true;
    }
}

void ccd_rates_changed(struct machine *m) { m->ccd.row_known[0] = m->ccd.row_known[1] = 0; }

static void world_moves(struct machine *m, uint64_t lit, uint64_t time) {
    if (!m->config.light || m->failed) return;
    fold_all(m, time); /* no weight is left: rates of LEDs that are not lit no longer count */
    int changed = m->config.light(time, lit);
    if (changed < 0)
        (void)call_failed(m);
    else if (changed)
        ccd_rates_changed(m);
}

void ccd_charge(struct machine *m, double *charge, uint64_t time) {
    const struct ccd *c = &m->ccd;
    count_light(m, time);
    weigh(&m->ccd);
    for (unsigned j = 0; j < PIXELS; j++) charge[j] = c->residue_scale * c->residue[j];
    for (unsigned k = 0; k < SOURCES; k++)
        if (c->weight[k] != 0.0)
            add_row(charge, m->config.rates + (size_t)k * PIXELS, c->weight[k]);
    for (unsigned j = 0; j < PIXELS; j++)
        if (charge[j] > m->config.full_well) charge[j] = m->config.full_well;
}

void ccd_light(struct machine *m, unsigned channel, bool on, uint64_t time) {
    struct ccd *c = &m->ccd;
    uint64_t bit = (uint64_t)1 << channel;
    if (((c->lit & bit) != 0) == on) return;
    if (on) {
        world_moves(m, c->lit | bit, time);
        c->lit |= bit;
        c->weighted |= bit;
        c->since[channel + 1] = time;
    } else {
        c->on[channel + 1] += time - c->since[channel + 1];
        c->lit &= ~bit;
    }
}

/* SH falls: the integration ends, a fraction of the charge goes to the register or away. */
static void transfer(struct machine *m, uint64_t time, bool to_register) {
    struct ccd *c = &m->ccd;
    double fraction = m->config.transfer_fraction;
    count_light(m, time);
    weigh(c);
    if (bound(m) > m->config.full_well) fold(m, m->config.full_well);
    if (to_register) {
        for (unsigned k = 0; k < SOURCES; k++) {
            c->out_weight[k] = fraction * c->weight[k];
            c->out_lit[k] = c->on[k];
        }
        c->out_scale = fraction * c->residue_scale;
        c->out_has_residue = c->residue_scale * c->residue_max > NEGLIGIBLE;
        if (c->out_has_residue) memcpy(c->out_residue, c->residue, sizeof c->residue);
        c->out_time = time;
        c->out_integration = time - c->sh_fall;
        c->reading = false;
        c->digitised = false;
    }
    c->residue_scale *= 1.0 - fraction;
    if (c->residue_max > 0.0 && c->residue_scale * c->residue_max < NEGLIGIBLE) {
        memset(c->residue, 0, sizeof c->residue);
        c->residue_max = 0.0;
        c->residue_scale = 1.0;
    } else if (c->residue_max <= 0.0) {
        c->residue_scale = 1.0;
    }
    c->weight[0] *= 1.0 - fraction;
    c->on[0] = c->counted[0] = 0;
    for (uint64_t set = c->weighted; set; set &= set - 1) {
        unsigned k = 1u + (unsigned)__builtin_ctzll(set);
        uint64_t bit = set & (0 - set);
        c->weight[k] *= 1.0 - fraction;
        c->on[k] = c->counted[k] = 0;
        if (!(c->lit & bit) && c->weight[k] * row_max(m, k) < NEGLIGIBLE) {
            c->weight[k] = 0.0;
            c->weighted &= ~bit;
        }
    }
}

/* --- pins ----------------------------------------------------------------------------------- */
static bool fm_level(struct machine *m, uint64_t time) {
    const struct pin *p = &m->pin[m->ccd.fm_pin];
    bool level = p->level;
    if (p->mode == 2 && p->timer != NO_PIN) level = tim_output(m, p->timer, p->channel, time);
    return level != (m->config.inverted != 0);
}

static uint64_t fm_period(const struct machine *m) {
    const struct pin *p = &m->pin[m->ccd.fm_pin];
    if (p->mode != 2 || p->timer == NO_PIN) return 0;
    return tim_period(m, p->timer, p->channel);
}

static uint32_t fm_version(const struct machine *m) {
    const struct pin *p = &m->pin[m->ccd.fm_pin];
    return p->mode == 2 && p->timer != NO_PIN ? m->tim[p->timer].version : 0;
}

static void problem(struct machine *m, uint32_t which, double value, uint64_t time, bool counts) {
    if (counts) m->ccd.problems |= which;
    violation(m, which, value, time);
}

void ccd_sh(struct machine *m, bool level, uint64_t time) {
    struct ccd *c = &m->ccd;
    if (level == c->sh) return;
    c->sh = level;
    if (level) {
        c->sh_rise = time;
        c->pulse_in_icg = !c->icg;
        if (!c->icg) {
            uint64_t t2 = time - c->icg_fall;
            c->pulses++;
            if (t2 < NANOSECONDS(100) || t2 > NANOSECONDS(1000))
                problem(m, PROBLEM_T2, seconds(t2), time, true);
        }
        return;
    }
    bool to_register = c->pulse_in_icg && !c->icg;
    uint64_t width = time - c->sh_rise, integration = time - c->sh_fall;
    if (width < MICROSECOND) problem(m, PROBLEM_T3, seconds(width), time, !c->icg);
    if (c->pulse_in_icg != !c->icg) problem(m, PROBLEM_SH_ICG, 0.0, time, true);
    if (to_register && integration < 10u * MICROSECOND)
        problem(m, PROBLEM_INTEGRATION, seconds(integration), time, true);
    transfer(m, time, to_register);
    c->integration = integration;
    c->sh_fall = time;
}

static void start_readout(struct machine *m, uint64_t time) {
    struct ccd *c = &m->ccd;
    uint64_t period = fm_period(m), t1 = time - c->sh_fall, icg_period = time - c->icg_rise;
    if (c->sh || t1 < MICROSECOND) problem(m, PROBLEM_T1, c->sh ? 0.0 : seconds(t1), time, true);
    if (!period || period < TICKS_PER_SECOND / 4000000u || period > TICKS_PER_SECOND / 800000u)
        problem(m, PROBLEM_FM, period ? 1.0 / seconds(period) : 0.0, time, true);
    else if (!fm_level(m, time))
        problem(m, PROBLEM_T4, 0.0, time, true);
    if (c->pulses != 1)
        problem(m, PROBLEM_SH_ICG, 0.0, time, true);
    else if (!c->integration || icg_period % c->integration)
        problem(m, PROBLEM_SH_ICG, seconds(icg_period % (c->integration ? c->integration : 1)), time,
                true);
    c->element = 4 * (period ? period : TICKS_PER_SECOND / 4000000u);
    c->icg_rise = time;
    c->end = time + ELEMENTS * c->element;
    c->fm_version = fm_version(m);
    c->reading = true;
    struct readout *r = &c->readouts[c->readout_count++ % READOUTS];
    *r = (struct readout){.transfer = c->out_time, .start = time, .problems = c->problems,
                          .integration = c->out_integration};
    memcpy(r->lit, c->out_lit, sizeof r->lit);
}

void ccd_icg(struct machine *m, bool level, uint64_t time) {
    struct ccd *c = &m->ccd;
    if (level == c->icg) return;
    c->icg = level;
    if (level) {
        start_readout(m, time);
        world_moves(m, c->lit, time);
        return;
    }
    if (c->reading && time < c->icg_rise + LAST_PIXEL * c->element) {
        violation(m, PROBLEM_CUT, seconds(c->end - time), time);
        c->readouts[(c->readout_count - 1) % READOUTS].problems |= PROBLEM_CUT;
    }
    c->icg_fall = time;
    c->pulses = 0;
    c->problems = 0;
    if (c->sh) problem(m, PROBLEM_SH_ICG, 0.0, time, true);
}

/* --- what the ADC sees ----------------------------------------------------------------------- */
static bool acceptable(struct machine *m) {
    static const char *const names[] = {
        "fM outside 0.8 to 4 MHz or not running",
        "t1: ICG rises within 1 us of SH's fall",
        "t2: SH does not rise 100 to 1000 ns after ICG's fall",
        "t3: SH pulse shorter than 1 us",
        "t4: ICG rises while fM is low",
        "SH period does not divide the ICG period, or SH and ICG pulses do not coincide",
        "integration time below 10 us",
        "read-out cut short by the next ICG pulse",
        "fM changed within the read-out"};
    uint32_t problems = m->ccd.problems;
    if (!problems) return true;
    if (!m->failed) m->timing_failed = true;
    fail(m, "TCD1304: %s (in a read-out that is sampled)", names[__builtin_ctz(problems)]);
    return false;
}

/* What the ADC reads from OS at `time`. */
uint16_t ccd_sample(struct machine *m, uint64_t time) {
    struct ccd *c = &m->ccd;
    /* a conversion ends after its sample was held: ICG may have fallen in between */
    bool open = c->icg || time < c->icg_fall;
    if (!c->reading || !open || time < c->icg_rise || time >= c->end) return c->codes[ELEMENTS];
    if (c->fm_version != fm_version(m)) {
        c->problems |= PROBLEM_FM_CHANGED;
        violation(m, PROBLEM_FM_CHANGED, 0.0, time);
    }
    if (!acceptable(m)) return 0;
    if (!c->digitised) {
        double charge[PIXELS];
        c->readouts[(c->readout_count - 1) % READOUTS].sampled = 1;
        out_charge(m, charge);
        c->digitised = true;
        if (m->config.digitise && m->config.digitise(charge, c->out_time, c->codes)) {
            (void)call_failed(m);
            return 0;
        }
    }
    return c->codes[(time - c->icg_rise) / c->element];
}
