/* Pins: GPIO ports, alternate functions, EXTI, and what each pin is wired to. */
#include <string.h>

#include "machine.h"

#define PIN(port, n) (16 * ((port) - 'A') + (n))

/* Outputs of timers that a pin can carry (datasheet, table 9): TIM2 on AF1, TIM3 to 5 on AF2. */
struct function {
    uint8_t pin, af, timer, channel;
};

static const struct function functions[] = {
    {PIN('A', 0), 1, 0, 0},  {PIN('A', 1), 1, 0, 1},  {PIN('A', 2), 1, 0, 2},
    {PIN('A', 3), 1, 0, 3},  {PIN('A', 5), 1, 0, 0},  {PIN('A', 15), 1, 0, 0},
    {PIN('B', 3), 1, 0, 1},  {PIN('B', 10), 1, 0, 2}, {PIN('A', 6), 2, 1, 0},
    {PIN('A', 7), 2, 1, 1},  {PIN('B', 0), 2, 1, 2},  {PIN('B', 1), 2, 1, 3},
    {PIN('B', 4), 2, 1, 0},  {PIN('B', 5), 2, 1, 1},  {PIN('C', 6), 2, 1, 0},
    {PIN('C', 7), 2, 1, 1},  {PIN('C', 8), 2, 1, 2},  {PIN('C', 9), 2, 1, 3},
    {PIN('B', 6), 2, 2, 0},  {PIN('B', 7), 2, 2, 1},  {PIN('B', 8), 2, 2, 2},
    {PIN('B', 9), 2, 2, 3},  {PIN('A', 0), 2, 3, 0},  {PIN('A', 1), 2, 3, 1},
    {PIN('A', 2), 2, 3, 2},  {PIN('A', 3), 2, 3, 3},
};

/* SPI2 on AF5, SPI3 on AF6; the wires decide what they mean. */
static const struct function links[] = {
    {PIN('B', 10), 5, 0, 0}, {PIN('B', 13), 5, 0, 0}, {PIN('B', 14), 5, 0, 0},
    {PIN('B', 15), 5, 0, 0}, {PIN('C', 2), 5, 0, 0},  {PIN('C', 3), 5, 0, 0},
    {PIN('C', 10), 6, 0, 0}, {PIN('C', 11), 6, 0, 0}, {PIN('C', 12), 6, 0, 0},
    {PIN('B', 3), 6, 0, 0},  {PIN('B', 4), 6, 0, 0},  {PIN('B', 5), 6, 0, 0},
};

static uint32_t mode_of(const struct machine *m, unsigned pin) {
    return (m->gpio[pin / 16].moder >> (2 * (pin % 16))) & 3;
}

static uint32_t af_of(const struct machine *m, unsigned pin) {
    return (m->gpio[pin / 16].afr[(pin % 16) / 8] >> (4 * (pin % 8))) & 15;
}

/* Must its edges happen on time? */
bool pin_observed(const struct machine *m, unsigned pin) {
    unsigned role = m->config.role[pin];
    if (role == ROLE_FM || role == ROLE_CLOCK)
        return m->config.record && m->config.record_clocks;
    return role != ROLE_NONE || m->config.record;
}

/* --- EXTI ----------------------------------------------------------------------------------- */
static void exti_lines(struct machine *m) {
    static const uint8_t irq[5] = {6, 7, 8, 9, 10};
    uint32_t pending = m->exti.pr & m->exti.imr;
    for (unsigned i = 0; i < 5; i++) irq_line(m, irq[i], (pending >> i) & 1);
    irq_line(m, 23, (pending & 0x03E0u) != 0);
    irq_line(m, 40, (pending & 0xFC00u) != 0);
}

/* The pending bit is set by the selected edge, masked or not. */
void exti_edge(struct machine *m, unsigned pin, bool rising, bool falling) {
    unsigned line = pin % 16;
    uint32_t bit = 1u << line;
    if (!((m->exti.rtsr | m->exti.ftsr) & bit)) return;
    if (((m->exti.exticr[line / 4] >> (4 * (line % 4))) & 15) != pin / 16) return;
    if (!((rising && (m->exti.rtsr & bit)) || (falling && (m->exti.ftsr & bit)))) return;
    if (m->exti.pr & bit) return;
    m->exti.pr |= bit;
    exti_lines(m);
}

void exti_reset(struct machine *m) {
    m->exti.imr = m->exti.emr = m->exti.rtsr = m->exti.ftsr = m->exti.pr = 0;
}

void syscfg_reset(struct machine *m) { memset(m->exti.exticr, 0, sizeof m->exti.exticr); }

uint32_t exti_read(struct machine *m, uint32_t offset) {
    switch (offset) {
    case 0x00: return m->exti.imr;
    case 0x04: return m->exti.emr;
    case 0x08: return m->exti.rtsr;
    case 0x0C: return m->exti.ftsr;
    case 0x10: return 0;
    case 0x14: return m->exti.pr;
    case 0x1008: case 0x100C: case 0x1010: case 0x1014:
        return m->exti.exticr[(offset - 0x1008) / 4];
    default: break;
    }
    fail(m, "%s is not modelled",
         register_name(m, offset < 0x1000 ? 0x40013C00u + offset : 0x40012800u + offset));
    return 0;
}

void exti_write(struct machine *m, uint32_t offset, uint32_t value) {
    uint32_t address = offset < 0x1000 ? 0x40013C00u + offset : 0x40012800u + offset;
    if (!allowed_bits(m, address, value, 0xFFFFu)) return;
    switch (offset) {
    case 0x00: m->exti.imr = value; break;
    case 0x04:
        if (value) fail(m, "EXTI_EMR: events are not modelled");
        break;
    case 0x08: m->exti.rtsr = value; break;
    case 0x0C: m->exti.ftsr = value; break;
    case 0x10: m->exti.pr |= value & m->exti.imr; break;
    case 0x14: m->exti.pr &= ~value; break;
    case 0x1008: case 0x100C: case 0x1010: case 0x1014:
        m->exti.exticr[(offset - 0x1008) / 4] = value;
        break;
    default: fail(m, "%s is not modelled", register_name(m, address));
    }
    exti_lines(m);
}

/* --- levels --------------------------------------------------------------------------------- */
void pin_set(struct machine *m, unsigned pin, bool level, uint64_t time) {
    unsigned role = m->config.role[pin];
    if (m->pin[pin].level == level) return;
    m->pin[pin].level = level;
    if (m->edges.size && pin_observed(m, pin) && mode_of(m, pin) != 0)
        record(m, time, pin, level);
    exti_edge(m, pin, level, !level);
    if (role >= ROLE_LED)
        ccd_light(m, role - ROLE_LED, level, time);
    else if (role == ROLE_SH)
        ccd_sh(m, level != (m->config.inverted != 0), time);
    else if (role == ROLE_ICG)
        ccd_icg(m, level != (m->config.inverted != 0), time);
    else if (role == ROLE_CHAIN_LATCH || role == ROLE_CHAIN_ENABLE)
        chain_pin(m, role, level, time);
    if (pin == m->watch_pin && level == m->watch_level) m->stop = true;
}

/* What nothing drives: as pulled, else 1 for the chain's output enable (pulled up), else 0. */
static bool floating(const struct machine *m, unsigned pin) {
    uint32_t pull = (m->gpio[pin / 16].pupdr >> (2 * (pin % 16))) & 3;
    if (m->pin[pin].driven) return m->pin[pin].driven & 1;
    if (pull) return pull == 1;
    return m->config.role[pin] == ROLE_CHAIN_ENABLE;
}

static void refresh(struct machine *m, unsigned pin, uint64_t time) {
    struct pin *p = &m->pin[pin];
    bool level = floating(m, pin);
    if (p->mode == 1)
        level = (m->gpio[pin / 16].odr >> (pin % 16)) & 1;
    else if (p->mode == 2 && p->timer != NO_PIN)
        level = tim_output(m, p->timer, p->channel, time);
    pin_set(m, pin, level, time);
}

static void unlink_timer(struct machine *m, unsigned pin) {
    struct pin *p = &m->pin[pin];
    if (p->timer == NO_PIN) return;
    uint8_t *pins = m->tim[p->timer].pins[p->channel];
    if (pins[0] == pin) pins[0] = NO_PIN;
    if (pins[1] == pin) pins[1] = NO_PIN;
    p->timer = NO_PIN;
}

static void link_timer(struct machine *m, unsigned pin, const struct function *f) {
    uint8_t *pins = m->tim[f->timer].pins[f->channel];
    unsigned slot = pins[0] == NO_PIN ? 0 : 1;
    if (pins[slot] != NO_PIN) {
        fail(m, "more than two pins on a timer's channel");
        return;
    }
    pins[slot] = (uint8_t)pin;
    m->pin[pin].timer = f->timer;
    m->pin[pin].channel = f->channel;
}

/* Mode or alternate function may have changed. */
static void configure(struct machine *m, unsigned pin, uint64_t time) {
    uint32_t mode = mode_of(m, pin), af = af_of(m, pin);
    const struct function *found = NULL;
    bool known = af == 0; /* JTAG and SWD, nobody's there */
    unlink_timer(m, pin);
    m->pin[pin].mode = (uint8_t)mode;
    m->pin[pin].link = false;
    if (mode == 2) {
        for (size_t i = 0; i < sizeof functions / sizeof functions[0]; i++)
            if (functions[i].pin == pin && functions[i].af == af) found = &functions[i];
        for (size_t i = 0; i < sizeof links / sizeof links[0]; i++)
            if (links[i].pin == pin && links[i].af == af) m->pin[pin].link = known = true;
        if (found)
            link_timer(m, pin, found);
        else if (!known)
            fail(m, "P%c%u: alternate function %u is not modelled", (int)('A' + pin / 16), pin % 16,
                 af);
    }
    refresh(m, pin, time);
    tim_replan(m);
}

void gpio_drive(struct machine *m, unsigned pin, uint8_t driven, uint64_t time) {
    m->pin[pin].driven = driven;
    refresh(m, pin, time);
}

static void reset_registers(struct gpio *g, unsigned port) {
    *g = (struct gpio){0};
    if (port == 0) *g = (struct gpio){.moder = 0xA8000000u, .pupdr = 0x64000000u};
    if (port == 1) *g = (struct gpio){.moder = 0x00000280u, .pupdr = 0x00000100u};
}

void gpio_reset(struct machine *m, unsigned port, uint64_t time) {
    reset_registers(&m->gpio[port], port);
    for (unsigned i = 0; i < 16; i++) {
        unlink_timer(m, 16 * port + i);
        configure(m, 16 * port + i, time);
    }
}

/* --- registers ------------------------------------------------------------------------------ */
uint32_t gpio_read(struct machine *m, unsigned port, uint32_t offset) {
    const struct gpio *g = &m->gpio[port];
    uint32_t value = 0;
    switch (offset) {
    case 0x00: return g->moder;
    case 0x04: return g->otyper;
    case 0x08: return g->ospeedr;
    case 0x0C: return g->pupdr;
    case 0x10:
        for (unsigned i = 0; i < 16; i++) {
            struct pin *p = &m->pin[16 * port + i];
            bool level = p->level;
            if (p->mode == 2 && p->timer != NO_PIN) /* it may be one that nobody observes */
                level = tim_output(m, p->timer, p->channel, m->now);
            if (level && p->mode != 3) value |= 1u << i;
        }
        return value;
    case 0x14: return g->odr;
    case 0x18: return 0;
    case 0x20: return g->afr[0];
    case 0x24: return g->afr[1];
    default: break;
    }
    fail(m, "%s is not modelled", register_name(m, 0x40020000u + 0x400u * port + offset));
    return 0;
}

static void write_odr(struct machine *m, unsigned port, uint32_t value) {
    uint32_t changed = m->gpio[port].odr ^ value;
    m->gpio[port].odr = value;
    for (unsigned i = 0; i < 16; i++)
        if (((changed >> i) & 1) && m->pin[16 * port + i].mode == 1)
            refresh(m, 16 * port + i, m->now);
}

void gpio_write(struct machine *m, unsigned port, uint32_t offset, uint32_t value) {
    struct gpio *g = &m->gpio[port];
    uint32_t address = 0x40020000u + 0x400u * port + offset, before;
    switch (offset) {
    case 0x00:
        before = g->moder;
        g->moder = value;
        for (unsigned i = 0; i < 16; i++)
            if (((before ^ value) >> (2 * i)) & 3) configure(m, 16 * port + i, m->now);
        break;
    case 0x04:
        if (allowed_bits(m, address, value, 0)) g->otyper = value; /* no open drain */
        break;
    case 0x08: g->ospeedr = value; break;
    case 0x0C:
        g->pupdr = value;
        for (unsigned i = 0; i < 16; i++) refresh(m, 16 * port + i, m->now);
        break;
    case 0x14:
        if (allowed_bits(m, address, value, 0xFFFFu)) write_odr(m, port, value);
        break;
    case 0x18: write_odr(m, port, (g->odr & ~(value >> 16)) | (value & 0xFFFFu)); break;
    case 0x20:
    case 0x24: {
        unsigned half = (offset - 0x20) / 4;
        before = g->afr[half];
        g->afr[half] = value;
        for (unsigned i = 0; i < 8; i++)
            if (((before ^ value) >> (4 * i)) & 15) configure(m, 16 * port + 8 * half + i, m->now);
        break;
    }
    default: fail(m, "%s is not modelled", register_name(m, address));
    }
}
