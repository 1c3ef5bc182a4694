/* NVIC, system control block, SysTick and the cycle counter (ARMv7-M, 4 priority bits). */
#include "machine.h"

#define IRQS 85u
#define CYCLES_ENABLED(m) (((m)->nvic.demcr >> 24) & (m)->nvic.dwt_ctrl & 1u)

static bool get_bit(const uint64_t *set, unsigned n) { return (set[n / 64] >> (n % 64)) & 1; }

static void put_bit(uint64_t *set, unsigned n, bool value) {
    uint64_t bit = (uint64_t)1 << (n % 64);
    set[n / 64] = value ? set[n / 64] | bit : set[n / 64] & ~bit;
}

void nvic_reset(struct machine *m) {
    struct nvic *n = &m->nvic;
    *n = (struct nvic){.vtor = FLASH_BASE, .ccr = 0x200, .fpccr = 0xC0000000u};
    n->enabled[0] = (1u << 11) | (1u << 14) | (1u << 15); /* SVCall, PendSV, SysTick */
    m->at[EVENT_SYSTICK] = NEVER;
}

void nvic_pend(struct machine *m, unsigned number) {
    put_bit(m->nvic.pending, number, true);
    m->nvic.changed = true;
}

void irq_line_changed(struct machine *m, unsigned irq, bool level) {
    put_bit(m->nvic.line, 16 + irq, level);
    if (level) nvic_pend(m, 16 + irq);
}

static int group(const struct machine *m, uint32_t priority) {
    return (int)(priority & ~((2u << m->nvic.prigroup) - 1u) & 0xFFu);
}

int nvic_group_priority(const struct machine *m, int number) {
    return group(m, m->nvic.priority[number]);
}

int nvic_active_priority(const struct machine *m) {
    int best = 256;
    for (unsigned word = 0; word < 2; word++)
        for (uint64_t set = m->nvic.active[word]; set; set &= set - 1) {
            int number = (int)(64 * word) + __builtin_ctzll(set);
            int priority = nvic_group_priority(m, number);
            if (priority < best) best = priority;
        }
    return best;
}

/* The pending, enabled exception that goes first; -1 if there is none. */
int nvic_best(const struct machine *m) {
    int best = -1, lowest = 256;
    for (unsigned word = 0; word < 2; word++)
        for (uint64_t set = m->nvic.pending[word] & m->nvic.enabled[word]; set; set &= set - 1) {
            int number = (int)(64 * word) + __builtin_ctzll(set);
            if (m->nvic.priority[number] < lowest) {
                lowest = m->nvic.priority[number];
                best = number;
            }
        }
    return best;
}

void nvic_activate(struct machine *m, int number) {
    put_bit(m->nvic.pending, (unsigned)number, false);
    put_bit(m->nvic.active, (unsigned)number, true);
    m->nvic.changed = true;
}

void nvic_deactivate(struct machine *m, int number) {
    put_bit(m->nvic.active, (unsigned)number, false);
    if (get_bit(m->nvic.line, (unsigned)number)) put_bit(m->nvic.pending, (unsigned)number, true);
    m->nvic.changed = true;
}

/* --- SysTick: counts LOAD, LOAD - 1 ... 0, reloads; the event is the step from 1 to 0 ------- */
static uint64_t systick_tick(const struct machine *m) {
    return (uint64_t)m->rcc.cpu * ((m->nvic.systick_ctrl & 4) ? 1 : 8);
}

static uint32_t systick_now(const struct machine *m) {
    const struct nvic *n = &m->nvic;
    if (!(n->systick_ctrl & 1) || !n->systick_load) return n->systick_value;
    /* systick_base: when the counter was (or will be) 0 */
    uint64_t tick = systick_tick(m);
    if (m->now < n->systick_base) return (uint32_t)((n->systick_base - m->now + tick - 1) / tick);
    uint64_t gone = (m->now - n->systick_base) / tick % (n->systick_load + 1u);
    return gone ? n->systick_load + 1u - (uint32_t)gone : 0;
}

static void systick_plan(struct machine *m) {
    struct nvic *n = &m->nvic;
    bool on = (n->systick_ctrl & 1) && n->systick_load;
    machine_schedule(m, EVENT_SYSTICK, on ? n->systick_base : NEVER);
}

void systick_event(struct machine *m, uint64_t time) {
    struct nvic *n = &m->nvic;
    n->systick_flag = true;
    if (n->systick_ctrl & 2) nvic_pend(m, 15);
    n->systick_base = time + (n->systick_load + 1u) * systick_tick(m);
    machine_schedule(m, EVENT_SYSTICK, n->systick_base);
}

static void systick_start(struct machine *m, uint32_t value) {
    /* one tick loads the counter, then it counts down to 0 */
    m->nvic.systick_base = m->now + (value + 1u) * systick_tick(m);
}

uint32_t cycle_counter(const struct machine *m) {
    if (!CYCLES_ENABLED(m)) return m->nvic.cycles_offset;
    return (uint32_t)((m->now - m->rcc.grid) / m->rcc.cpu) + m->nvic.cycles_offset;
}

static void set_cycle_counter(struct machine *m, uint32_t value) {
    m->nvic.cycles_offset = value;
    if (CYCLES_ENABLED(m)) m->nvic.cycles_offset = value - (cycle_counter(m) - value);
}

/* --- registers ------------------------------------------------------------------------------ */
static uint32_t word(const uint64_t *set, uint32_t index) {
    unsigned first = 16 + 32 * index;
    uint64_t low = set[first / 64] >> (first % 64);
    if (first % 64 > 32 && first / 64 == 0) low |= set[1] << (64 - first % 64);
    return (uint32_t)low;
}

static void change(struct machine *m, uint64_t *set, uint32_t index, uint32_t bits, bool value) {
    for (unsigned i = 0; i < 32; i++)
        if ((bits >> i) & 1) {
            unsigned irq = 32 * index + i;
            if (irq >= IRQS) {
                fail(m, "interrupt %u does not exist", irq);
                return;
            }
            put_bit(set, 16 + irq, value);
        }
    m->nvic.changed = true;
}

static uint32_t icsr(struct machine *m) {
    const struct nvic *n = &m->nvic;
    int best = nvic_best(m); /* PRIMASK does not hide it, BASEPRI and FAULTMASK do */
    unsigned count = 0;
    if (best >= 0 && nvic_group_priority(m, best) >= cpu_masked_priority(m)) best = -1;
    bool irq = (n->pending[0] >> 16) || n->pending[1];
    for (unsigned i = 0; i < EXCEPTIONS; i++)
        count += get_bit(n->active, i);
    return cpu_exception(m) | (count <= 1 ? 0x800u : 0) | (best > 0 ? (uint32_t)best << 12 : 0) |
           (irq ? 1u << 22 : 0) | (get_bit(n->pending, 15) ? 1u << 26 : 0) |
           (get_bit(n->pending, 14) ? 1u << 28 : 0);
}

uint32_t nvic_read(struct machine *m, uint32_t address) {
    struct nvic *n = &m->nvic;
    uint32_t offset = address - 0xE000E000u;
    if (offset >= 0x100 && offset < 0x10C) return word(n->enabled, (offset - 0x100) / 4);
    if (offset >= 0x180 && offset < 0x18C) return word(n->enabled, (offset - 0x180) / 4);
    if (offset >= 0x200 && offset < 0x20C) return word(n->pending, (offset - 0x200) / 4);
    if (offset >= 0x280 && offset < 0x28C) return word(n->pending, (offset - 0x280) / 4);
    if (offset >= 0x300 && offset < 0x30C) return word(n->active, (offset - 0x300) / 4);
    if ((offset >= 0x400 && offset < 0x458) || (offset >= 0xD18 && offset < 0xD24)) {
        const uint8_t *p = offset < 0xD00 ? &n->priority[16 + offset - 0x400]
                                          : &n->priority[4 + offset - 0xD18];
        return (uint32_t)p[0] | (uint32_t)p[1] << 8 | (uint32_t)p[2] << 16 | (uint32_t)p[3] << 24;
    }
    switch (address) {
    case 0xE0001000u: return n->dwt_ctrl | 0x40000000u;
    case 0xE0001004u: return cycle_counter(m);
    case 0xE000E004u: return 2; /* ICTR: 96 lines */
    case 0xE000E010u: {
        uint32_t value = n->systick_ctrl | (n->systick_flag ? 1u << 16 : 0);
        n->systick_flag = false;
        return value;
    }
    case 0xE000E014u: return n->systick_load;
    case 0xE000E018u: return systick_now(m);
    case 0xE000E01Cu: return 10500; /* CALIB: 1 ms at HCLK / 8 of 84 MHz */
    case 0xE000ED00u: return 0x410FC241u;
    case 0xE000ED04u: return icsr(m);
    case 0xE000ED08u: return n->vtor;
    case 0xE000ED0Cu: return 0xFA050000u | n->prigroup << 8;
    case 0xE000ED10u: return n->scr;
    case 0xE000ED14u: return n->ccr;
    case 0xE000ED24u:
        return n->shcsr | (get_bit(n->active, 11) ? 1u << 7 : 0) |
               (get_bit(n->active, 14) ? 1u << 10 : 0) | (get_bit(n->active, 15) ? 1u << 11 : 0) |
               (get_bit(n->pending, 11) ? 1u << 15 : 0);
    case 0xE000ED28u: /* CFSR, HFSR, DFSR: faults stop the machine, so there were none */
    case 0xE000ED2Cu:
    case 0xE000ED30u: return 0;
    case 0xE000ED88u: return n->cpacr;
    case 0xE000EDF0u: return 0; /* DHCSR: no debugger */
    case 0xE000EDFCu: return n->demcr;
    case 0xE000EF34u: return n->fpccr;
    default: fail(m, "%s is not modelled", register_name(m, address)); return 0;
    }
}

static void write_priority(struct machine *m, uint32_t address, unsigned size, uint32_t value) {
    uint32_t offset = address - 0xE000E000u;
    uint8_t *p = offset < 0xD00 ? &m->nvic.priority[16 + offset - 0x400]
                                : &m->nvic.priority[4 + offset - 0xD18];
    for (unsigned i = 0; i < size; i++) p[i] = (uint8_t)((value >> (8 * i)) & 0xF0u);
    m->nvic.changed = true;
}

void nvic_write(struct machine *m, uint32_t address, unsigned size, uint32_t value) {
    struct nvic *n = &m->nvic;
    uint32_t offset = address - 0xE000E000u;
    if ((offset >= 0x400 && offset < 0x458) || (offset >= 0xD18 && offset < 0xD24)) {
        write_priority(m, address, size, value);
        return;
    }
    if (size != 4) {
        fail(m, "%s takes words only", register_name(m, address));
        return;
    }
    if (offset >= 0x100 && offset < 0x10C)
        change(m, n->enabled, (offset - 0x100) / 4, value, true);
    else if (offset >= 0x180 && offset < 0x18C)
        change(m, n->enabled, (offset - 0x180) / 4, value, false);
    else if (offset >= 0x200 && offset < 0x20C)
        change(m, n->pending, (offset - 0x200) / 4, value, true);
    else if (offset >= 0x280 && offset < 0x28C) {
        change(m, n->pending, (offset - 0x280) / 4, value, false);
        for (unsigned i = 0; i < 2; i++) n->pending[i] |= n->line[i] & ~n->active[i];
    } else
        switch (address) {
        case 0xE0001000u:
            if (allowed_bits(m, address, value & ~0x40000000u, 1)) {
                uint32_t count = cycle_counter(m);
                n->dwt_ctrl = value & 1;
                set_cycle_counter(m, count);
            }
            break;
        case 0xE0001004u: set_cycle_counter(m, value); break;
        case 0xE000E010u:
            if (!allowed_bits(m, address, value & ~0x10000u, 7)) break;
            if (!(n->systick_ctrl & 1) && (value & 1)) {
                n->systick_ctrl = value & 7;
                systick_start(m, n->systick_value ? n->systick_value - 1 : n->systick_load);
            } else if ((n->systick_ctrl ^ value) & n->systick_ctrl & 1) {
                n->systick_value = systick_now(m);
                n->systick_ctrl = value & 7;
            } else {
                if ((n->systick_ctrl ^ value) & value & 4 & (n->systick_ctrl << 2))
                    fail(m, "SysTick's clock may not change while it counts");
                n->systick_ctrl = value & 7;
            }
            n->systick_flag = false;
            systick_plan(m);
            break;
        case 0xE000E014u:
            if (allowed_bits(m, address, value, 0xFFFFFFu)) n->systick_load = value;
            break;
        case 0xE000E018u:
            n->systick_value = 0;
            n->systick_flag = false;
            if (n->systick_ctrl & 1) systick_start(m, n->systick_load);
            systick_plan(m);
            break;
        case 0xE000ED04u:
            if (!allowed_bits(m, address, value, 0x1E000000u)) break;
            if (value & (1u << 28)) nvic_pend(m, 14);
            if (value & (1u << 27)) put_bit(n->pending, 14, false);
            if (value & (1u << 26)) nvic_pend(m, 15);
            if (value & (1u << 25)) put_bit(n->pending, 15, false);
            break;
        case 0xE000ED08u:
            if (allowed_bits(m, address, value, 0x3FFFFE00u)) n->vtor = value;
            break;
        case 0xE000ED0Cu:
            if (value >> 16 != 0x05FAu)
                fail(m, "AIRCR written without its key");
            else if (allowed_bits(m, address, value & 0xFFFFu, 0x700))
                n->prigroup = (value >> 8) & 7;
            n->changed = true;
            break;
        case 0xE000ED10u:
            if (allowed_bits(m, address, value, 2)) n->scr = value;
            break;
        case 0xE000ED14u:
            if (allowed_bits(m, address, value, 0x200)) n->ccr = value; /* STKALIGN */
            if (!(value & 0x200)) fail(m, "CCR: STKALIGN = 0 is not modelled");
            break;
        case 0xE000ED24u: /* faults are fatal, whatever handler is enabled */
            if (allowed_bits(m, address, value, 0x70000)) n->shcsr = value;
            break;
        case 0xE000ED88u:
            if (allowed_bits(m, address, value, 0x00F00000u)) n->cpacr = value;
            break;
        case 0xE000EDFCu:
            if (allowed_bits(m, address, value, 0x01000000u)) {
                uint32_t count = cycle_counter(m);
                n->demcr = value;
                set_cycle_counter(m, count);
            }
            break;
        case 0xE000EF00u: {
            uint32_t irq = value & 0x1FF;
            if (irq >= IRQS)
                fail(m, "interrupt %u does not exist", irq);
            else
                nvic_pend(m, 16 + irq);
            break;
        }
        case 0xE000EF34u:
            if (allowed_bits(m, address, value, 0xC0000000u)) n->fpccr = value;
            if (!(value >> 31)) fail(m, "FPCCR: ASPEN = 0 is not modelled");
            break;
        default: fail(m, "%s is not modelled", register_name(m, address));
        }
}
