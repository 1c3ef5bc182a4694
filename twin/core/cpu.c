/* The processor: unicorn executes the instructions, this file counts their cycles and takes
 * exceptions. Both happen in a hook called before every instruction, so that interrupts fall
 * exactly between two of them.
 *
 * Cycles (Cortex-M4 TRM, table 3-1; flash accelerator on, no bus contention): 1 an instruction;
 * loads and stores 2 (of n registers 1 + n); MRS, MSR, CPS 2; a branch that is taken 2 more;
 * TBB, TBH 2; SDIV, UDIV 7 (2 to 12); DMB, DSB, ISB 3; VDIV, VSQRT 14; VFMA and the like 3.
 * Exception entry 12, return 10, tail-chained entry 6.
 */
#include <string.h>

#include "machine.h"

#define ENTRY_CYCLES 12u
#define RETURN_CYCLES 10u
#define TAIL_CYCLES 6u
#define BRANCH_CYCLES 2u

#define KIND_KNOWN 0x8000u
#define KIND_WFI 0x0100u
#define KIND_IT 0x0200u
#define KIND_FPU 0x0400u
#define KIND_EVENT 0x0800u /* WFE, SEV, YIELD: not modelled */
#define COST 0x00FFu

static uint32_t get(struct machine *m, int reg) {
    uint32_t value = 0;
    (void)m->config.unicorn.reg_read(m->uc, reg, &value);
    return value;
}

uint32_t cpu_exception(struct machine *m) { return get(m, UC_ARM_REG_XPSR) & 0x1FFu; }

static void set(struct machine *m, int reg, uint32_t value) {
    (void)m->config.unicorn.reg_write(m->uc, reg, &value);
}

static unsigned bits_set(uint32_t value) { return (unsigned)__builtin_popcount(value); }

static uint32_t decode_16(uint32_t h) {
    if ((h & 0xF000u) == 0x5000u || (h & 0xE000u) == 0x6000u || (h & 0xF000u) == 0x8000u ||
        (h & 0xF000u) == 0x9000u || (h & 0xF800u) == 0x4800u)
        return 2; /* LDR, STR */
    if ((h & 0xF600u) == 0xB400u) return 1 + bits_set(h & 0x1FFu); /* PUSH, POP */
    if ((h & 0xF000u) == 0xC000u) return 1 + bits_set(h & 0xFFu);  /* LDM, STM */
    if ((h & 0xFFE8u) == 0xB660u) return 2;                        /* CPS */
    if (h == 0xBF30u) return 1 | KIND_WFI;
    if (h == 0xBF10u || h == 0xBF20u || h == 0xBF40u) return 1 | KIND_EVENT;
    if ((h & 0xFF00u) == 0xBF00u && (h & 0xFu)) return 1 | KIND_IT;
    return 1;
}

static uint32_t decode_32(uint32_t a, uint32_t b) {
    if ((a & 0xFE40u) == 0xE800u) return 1 + bits_set(b); /* LDM, STM */
    if ((a & 0xFFF0u) == 0xE8D0u && (b & 0xFFE0u) == 0xF000u) return 2; /* TBB, TBH */
    if ((a & 0xFE40u) == 0xE840u) return ((a & 0xFF00u) == 0xE800u && !(a & 0x0080u)) ? 2 : 3;
    if ((a & 0xFE00u) == 0xF800u) return 2; /* LDR, STR */
    if ((a & 0xFF90u) == 0xFB90u) return 7; /* SDIV, UDIV */
    if ((a & 0xFC00u) == 0xEC00u && (b & 0x0E00u) == 0x0A00u) { /* coprocessors 10 and 11 */
        if ((a & 0xFE00u) == 0xEC00u) { /* loads, stores, moves of pairs */
            if ((a & 0xFFE0u) == 0xEC40u) return 2 | KIND_FPU;
            if ((a & 0xFF20u) == 0xED00u) return ((b & 0x0100u) ? 3u : 2u) | KIND_FPU;
            return (1 + (b & 0xFFu)) | KIND_FPU;
        }
        if ((a & 0xFFB0u) == 0xEE80u && !(b & 0x10u)) return 14 | KIND_FPU;  /* VDIV */
        if ((a & 0xFFBFu) == 0xEEB1u && (b & 0xD0u) == 0xC0u) return 14 | KIND_FPU; /* VSQRT */
        if ((a & 0xFFA0u) == 0xEEA0u && !(b & 0x10u)) return 3 | KIND_FPU;   /* VFMA, VFNMA */
        if ((a & 0xFFA0u) == 0xEE00u && !(b & 0x10u)) return 3 | KIND_FPU;   /* VMLA */
        return 1 | KIND_FPU;
    }
    if ((a & 0xFFE0u) == 0xF380u || (a & 0xFFE0u) == 0xF3E0u) return 2; /* MSR, MRS */
    if ((a & 0xFFF0u) == 0xF3B0u) return 3;                            /* DMB, DSB, ISB */
    if (a == 0xF3AFu && (b & 0xFF00u) == 0x8000u) {
        if ((b & 0xFFu) == 3) return 1 | KIND_WFI;
        if (b & 0xFFu) return 1 | KIND_EVENT;
    }
    return 1;
}

static const uint8_t *code_at(const struct machine *m, uint32_t address) {
    if (address - FLASH_BASE < FLASH_SIZE) return m->flash + (address - FLASH_BASE);
    return m->ram + (address - RAM_BASE) % RAM_SIZE;
}

static uint32_t decode(const struct machine *m, uint32_t pc, uint32_t size) {
    uint16_t half[2] = {0, 0};
    memcpy(half, code_at(m, pc), size <= 4 ? size : 4);
    return KIND_KNOWN | (size == 2 ? decode_16(half[0]) : decode_32(half[0], half[1]));
}

/* Count the instruction that has run; `pc` is where it led to. */
static void settle(struct machine *m, uint32_t pc) {
    struct cpu *c = &m->cpu;
    uint32_t cycles = c->cost;
    c->cost = 0;
    if (cycles && pc != c->next) {
        if (c->next > c->it_first && pc > c->next && pc <= c->it_end)
            cycles += (pc - c->next) / 2; /* skipped within an IT block */
        else
            cycles += BRANCH_CYCLES;
    }
    m->now += (uint64_t)cycles * m->rcc.cpu;
}

static void spend(struct machine *m, uint32_t cycles) {
    m->now += (uint64_t)cycles * m->rcc.cpu;
    machine_events(m, m->now);
}

static void exception_log(struct machine *m, int number, unsigned kind) {
    struct exception_entry e = {.time = m->now, .number = (uint16_t)number, .kind = (uint8_t)kind};
    log_add(m, &m->exceptions, &e);
}

static uint8_t *stack_at(struct machine *m, uint32_t address, uint32_t size) {
    uint32_t offset = address - RAM_BASE;
    if (offset >= RAM_SIZE || offset + size > RAM_SIZE) {
        fail(m, "stack pointer 0x%08X leaves RAM", address);
        return NULL;
    }
    return m->ram + offset;
}

int cpu_masked_priority(struct machine *m) {
    uint32_t basepri = get(m, UC_ARM_REG_BASEPRI) & 0xF0u;
    if (get(m, UC_ARM_REG_FAULTMASK) & 1) return -1;
    return basepri ? (int)(basepri & ~((2u << m->nvic.prigroup) - 1u)) : 256;
}

/* May it preempt, leaving PRIMASK aside? */
static bool would_preempt(struct machine *m, int number) {
    int priority = nvic_group_priority(m, number);
    return priority < nvic_active_priority(m) && priority < cpu_masked_priority(m);
}

/* The exception to take now, or -1. */
static int exception_due(struct machine *m) {
    int number = nvic_best(m);
    if (number < 0 || nvic_group_priority(m, number) >= nvic_active_priority(m)) {
        m->nvic.changed = false;
        return -1;
    }
    if ((get(m, UC_ARM_REG_PRIMASK) & 1) && nvic_group_priority(m, number) >= 0) return -1;
    return would_preempt(m, number) ? number : -1;
}

static void jump_to_handler(struct machine *m, int number, uint32_t exc_return) {
    uint32_t address = m->nvic.vtor + 4u * (uint32_t)number;
    uint32_t vector = 0;
    if (address - FLASH_BASE < FLASH_SIZE - 4 || address - RAM_BASE < RAM_SIZE - 4)
        memcpy(&vector, code_at(m, address), 4);
    else
        fail(m, "vector table at 0x%08X is outside flash and RAM", m->nvic.vtor);
    if (!(vector & 1)) {
        fail(m, "vector %d is 0x%08X: not a Thumb address", number, vector);
        return;
    }
    nvic_activate(m, number);
    set(m, UC_ARM_REG_XPSR, 0x01000000u | (uint32_t)number);
    set(m, UC_ARM_REG_LR, exc_return);
    uint32_t control = get(m, UC_ARM_REG_CONTROL);
    if (control & 4) set(m, UC_ARM_REG_CONTROL, control & ~4u); /* of a handler that chains */
    m->cpu.cost = 0;
    set(m, UC_ARM_REG_PC, vector);
}

static void exception_enter(struct machine *m, uint32_t pc) {
    static const int saved[6] = {UC_ARM_REG_R0, UC_ARM_REG_R1,  UC_ARM_REG_R2,
                                 UC_ARM_REG_R3, UC_ARM_REG_R12, UC_ARM_REG_LR};
    uint32_t control = get(m, UC_ARM_REG_CONTROL);
    uint32_t xpsr = get(m, UC_ARM_REG_XPSR) & ~0x0700FC00u; /* no IT, no alignment bit yet */
    uint32_t handler = xpsr & 0x1FFu;
    bool fp = (control & 4) != 0;
    uint32_t size = fp ? 104 : 32;
    uint32_t old = get(m, UC_ARM_REG_SP);
    uint32_t sp = (old & ~7u) - size;
    uint32_t frame[26] = {0};
    uint8_t *stack = stack_at(m, sp, size);
    if (!stack) return;
    if (control & 1) {
        fail(m, "unprivileged code is not modelled");
        return;
    }
    for (unsigned i = 0; i < 6; i++) frame[i] = get(m, saved[i]);
    frame[6] = pc;
    frame[7] = xpsr | 0x01000000u | ((old & 4u) ? 0x200u : 0);
    if (fp) {
        for (int i = 0; i < 8; i++)
            (void)m->config.unicorn.reg_read(m->uc, UC_ARM_REG_D0 + i, &frame[8 + 2 * i]);
        frame[24] = get(m, UC_ARM_REG_FPSCR);
    }
    memcpy(stack, frame, size);
    set(m, UC_ARM_REG_SP, sp);
    uint32_t exc_return = (handler ? 0xFFFFFFF1u : (control & 2) ? 0xFFFFFFFDu : 0xFFFFFFF9u);
    if (fp) exc_return &= ~0x10u;
    if (control & 6) set(m, UC_ARM_REG_CONTROL, control & ~6u);
    m->cpu.it_first = m->cpu.it_end = 0;
    spend(m, ENTRY_CYCLES); /* what arrives meanwhile may be taken instead */
    if (m->failed) return;
    int number = nvic_best(m);
    if (number < 0) {
        fail(m, "the interrupt that was being taken has gone");
        return;
    }
    exception_log(m, number, 0);
    jump_to_handler(m, number, exc_return);
}

static void exception_return(struct machine *m, uint32_t exc_return) {
    static const int saved[6] = {UC_ARM_REG_R0, UC_ARM_REG_R1,  UC_ARM_REG_R2,
                                 UC_ARM_REG_R3, UC_ARM_REG_R12, UC_ARM_REG_LR};
    int number = (int)(get(m, UC_ARM_REG_XPSR) & 0x1FFu);
    uint32_t kind = exc_return | 1u; /* the engine drops bit 0 */
    uint32_t base = kind | 0x10u;
    if (base != 0xFFFFFFF1u && base != 0xFFFFFFF9u && base != 0xFFFFFFFDu) {
        fail(m, "0x%08X is no EXC_RETURN", kind);
        return;
    }
    exception_log(m, number, 2);
    nvic_deactivate(m, number);
    if (get(m, UC_ARM_REG_FAULTMASK)) set(m, UC_ARM_REG_FAULTMASK, 0);
    int due = exception_due(m);
    if (due >= 0) {
        spend(m, TAIL_CYCLES);
        if (m->failed) return;
        due = nvic_best(m);
        exception_log(m, due, 1);
        jump_to_handler(m, due, kind);
        return;
    }
    bool fp = !(kind & 0x10u), process = base == 0xFFFFFFFDu;
    bool to_handler = base == 0xFFFFFFF1u;
    uint32_t size = fp ? 104 : 32;
    uint32_t sp = process ? get(m, UC_ARM_REG_PSP) : get(m, UC_ARM_REG_MSP);
    uint8_t *stack = stack_at(m, sp, size);
    uint32_t frame[26];
    if (!stack) return;
    memcpy(frame, stack, size);
    uint32_t xpsr = frame[7];
    if (to_handler != ((xpsr & 0x1FFu) != 0) || (!to_handler && nvic_active_priority(m) < 256)) {
        fail(m, "EXC_RETURN 0x%08X does not fit the active exceptions", kind);
        return;
    }
    if (xpsr & 0x0600FC00u) {
        fail(m, "return into an IT block: xPSR 0x%08X", xpsr);
        return;
    }
    uint32_t popped = (sp + size) | ((xpsr & 0x200u) ? 4u : 0u);
    set(m, UC_ARM_REG_XPSR_NZCVQG, xpsr & ~0x200u);
    uint32_t control = (get(m, UC_ARM_REG_CONTROL) & ~6u) | (process ? 2u : 0u) | (fp ? 4u : 0u);
    if (control != get(m, UC_ARM_REG_CONTROL)) set(m, UC_ARM_REG_CONTROL, control);
    for (unsigned i = 0; i < 6; i++) set(m, saved[i], frame[i]);
    if (fp) {
        for (int i = 0; i < 8; i++)
            (void)m->config.unicorn.reg_write(m->uc, UC_ARM_REG_D0 + i, &frame[8 + 2 * i]);
        set(m, UC_ARM_REG_FPSCR, frame[24]);
    }
    set(m, UC_ARM_REG_SP, popped);
    spend(m, RETURN_CYCLES);
    m->cpu.sleep_on_exit = !to_handler && (m->nvic.scr & 2);
    set(m, UC_ARM_REG_PC, frame[6] | 1u);
}

/* Sleep until an exception is pending that PRIMASK alone may hold back. False: not yet. */
static bool wait_for_exception(struct machine *m) {
    for (;;) {
        int number = nvic_best(m);
        if (number >= 0 && would_preempt(m, number)) break;
        uint64_t until = m->deadline;
        m->nvic.changed = false;
        do {
            if (m->failed || m->stop) return false;
            if (!machine_event(m, until)) {
                if (m->now < until) m->now = until;
                return false;
            }
        } while (!m->nvic.changed);
    }
    uint64_t into = (m->now - m->rcc.grid) % m->rcc.cpu;
    if (into) m->now += m->rcc.cpu - into;
    machine_events(m, m->now);
    return !m->failed;
}

static void halt(struct machine *m) { (void)m->config.unicorn.emu_stop(m->uc); }

static void on_instruction(uc_engine *uc, uint64_t address, uint32_t size, void *user) {
    struct machine *m = user;
    struct cpu *c = &m->cpu;
    uint32_t pc = (uint32_t)address;
    (void)uc;
    settle(m, pc);
    c->pc = pc;
    c->next = pc;
    if (m->now >= m->next) machine_events(m, m->now);
    if (m->failed || m->stop || m->now >= m->deadline) {
        halt(m);
        return;
    }
    if (c->sleep_on_exit) {
        if (!wait_for_exception(m)) {
            halt(m);
            return;
        }
        c->sleep_on_exit = false;
    }
    if (m->nvic.changed && !(pc > c->it_first && pc < c->it_end) && exception_due(m) >= 0) {
        exception_enter(m, pc);
        if (m->failed) halt(m);
        return;
    }
    uint32_t code;
    if (pc - FLASH_BASE < FLASH_SIZE) {
        uint16_t *known = &c->decoded[(pc - FLASH_BASE) / 2];
        if (!*known) *known = (uint16_t)decode(m, pc, size);
        code = *known;
    } else {
        code = decode(m, pc, size);
    }
    c->next = pc + size;
    c->cost = code & COST;
    if (!(code & (KIND_WFI | KIND_IT | KIND_FPU | KIND_EVENT))) return;
    if (code & KIND_IT) {
        uint32_t mask = 0;
        uint16_t half;
        memcpy(&half, code_at(m, pc), 2);
        mask = half & 0xFu;
        c->it_first = pc;
        c->it_end = pc + 2;
        for (unsigned n = 4u - (unsigned)__builtin_ctz(mask); n > 0; n--) {
            memcpy(&half, code_at(m, c->it_end), 2);
            c->it_end += (half >> 11) >= 0x1Du ? 4u : 2u;
        }
    } else if (code & KIND_FPU) {
        if ((m->nvic.cpacr & 0x00F00000u) != 0x00F00000u) {
            fail(m, "floating point while CPACR keeps the FPU off");
            halt(m);
        }
    } else if (code & KIND_EVENT) {
        fail(m, "WFE, SEV and YIELD are not modelled");
        halt(m);
    } else {
        c->cost = 0;
        c->next = pc;
        if (!wait_for_exception(m)) {
            halt(m);
            return;
        }
        m->nvic.changed = true;
        if (exception_due(m) >= 0) {
            exception_enter(m, pc + size);
            if (m->failed) halt(m);
        } else {
            c->cost = 1;
            c->next = pc + size;
            set(m, UC_ARM_REG_PC, (pc + size) | 1u);
        }
    }
}

static void on_interrupt(uc_engine *uc, uint32_t number, void *user) {
    struct machine *m = user;
    uint32_t pc = get(m, UC_ARM_REG_PC);
    (void)uc;
    settle(m, pc);
    machine_events(m, m->now);
    if (m->failed) {
        halt(m);
        return;
    }
    if (number == 8) {
        exception_return(m, pc);
    } else if (number == 2) {
        nvic_pend(m, 11);
        if (exception_due(m) >= 0)
            exception_enter(m, pc);
        else
            fail(m, "SVC while its priority does not allow it: HardFault");
    } else if (number == 7) {
        fail(m, "BKPT");
    } else {
        fail(m, "fault: engine's interrupt %u (HardFault)", number);
    }
    if (m->failed) halt(m);
}

static bool on_bad_access(uc_engine *uc, uc_mem_type type, uint64_t address, int size,
                          int64_t value, void *user) {
    struct machine *m = user;
    const char *what = "access to";
    (void)uc, (void)value;
    if (type == UC_MEM_WRITE_PROT)
        what = "write to flash at";
    else if (type == UC_MEM_WRITE_UNMAPPED)
        what = "write to unmapped";
    else if (type == UC_MEM_READ_UNMAPPED)
        what = "read from unmapped";
    else if (type == UC_MEM_FETCH_UNMAPPED || type == UC_MEM_FETCH_PROT)
        what = "execution outside flash and RAM, at";
    fail(m, "%s 0x%08X, %d bytes%s", what, (uint32_t)address, size,
         address < 0x1000 ? ": a null pointer" : "");
    halt(m);
    return false;
}

static bool check(struct machine *m, uc_err error, const char *what) {
    if (error == UC_ERR_OK) return true;
    fail(m, "unicorn: %s: %s", what, m->config.unicorn.strerror(error));
    return false;
}

bool cpu_open(struct machine *m) {
    const struct unicorn *u = &m->config.unicorn;
    uc_hook hook;
    uc_mode mode = (uc_mode)(UC_MODE_THUMB | UC_MODE_MCLASS);
    if (!check(m, u->open(UC_ARCH_ARM, mode, &m->uc), "open")) return false;
    /* what the header's macros uc_ctl_set_cpu_model and uc_ctl_exits_enable stand for */
    if (!check(m, u->ctl(m->uc, (uc_control_type)UC_CTL_WRITE(UC_CTL_CPU_MODEL, 1),
                         UC_CPU_ARM_CORTEX_M4), "Cortex-M4"))
        return false;
    if (!check(m, u->mem_map_ptr(m->uc, FLASH_BASE, FLASH_SIZE, UC_PROT_READ | UC_PROT_EXEC,
                                 m->flash), "flash"))
        return false;
    if (!check(m, u->mem_map_ptr(m->uc, RAM_BASE, RAM_SIZE, UC_PROT_ALL, m->ram), "RAM"))
        return false;
    if (!check(m, u->mmio_map(m->uc, PERIPHERALS, 0x80000, bus_mmio_read, m, bus_mmio_write, m),
               "peripherals"))
        return false;
    if (!check(m, u->mmio_map(m->uc, SYSTEM, 0x100000, bus_system_read, m, bus_system_write, m),
               "system space"))
        return false;
    const uint64_t all = 1, none = 0; /* begin > end: everywhere */
    return check(m, u->hook_add(m->uc, &hook, UC_HOOK_CODE, (void *)(uintptr_t)on_instruction, m,
                                all, none), "hook") &&
           check(m, u->hook_add(m->uc, &hook, UC_HOOK_INTR, (void *)(uintptr_t)on_interrupt, m,
                                all, none), "hook") &&
           check(m, u->hook_add(m->uc, &hook, UC_HOOK_MEM_UNMAPPED | UC_HOOK_MEM_PROT,
                                (void *)(uintptr_t)on_bad_access, m, all, none), "hook") &&
           check(m, u->ctl(m->uc, (uc_control_type)UC_CTL_WRITE(UC_CTL_UC_USE_EXITS, 1), 1),
                 "exits");
}

void cpu_reset(struct machine *m) {
    uint32_t vector[2];
    memcpy(vector, m->flash, sizeof vector);
    set(m, UC_ARM_REG_XPSR_NZCVQG, 0x01000000u);
    set(m, UC_ARM_REG_CONTROL, 0);
    set(m, UC_ARM_REG_PRIMASK, 0);
    set(m, UC_ARM_REG_FAULTMASK, 0);
    set(m, UC_ARM_REG_BASEPRI, 0);
    set(m, UC_ARM_REG_FPSCR, 0);
    set(m, UC_ARM_REG_PSP, 0);
    for (int i = 0; i <= 12; i++) set(m, UC_ARM_REG_R0 + i, 0);
    set(m, UC_ARM_REG_LR, 0xFFFFFFFFu);
    set(m, UC_ARM_REG_SP, vector[0] & ~3u);
    if (!(vector[1] & 1)) fail(m, "the reset vector is 0x%08X: not a Thumb address", vector[1]);
    set(m, UC_ARM_REG_PC, vector[1]);
    m->cpu.pc = m->cpu.next = vector[1] & ~1u;
    m->cpu.cost = 0;
    m->cpu.it_first = m->cpu.it_end = 0;
    m->cpu.sleep_on_exit = false;
}

void cpu_run(struct machine *m) {
    uint64_t pc = get(m, UC_ARM_REG_PC) | 1u;
    uc_err error = m->config.unicorn.emu_start(m->uc, pc, 0, 0, 0);
    if (error != UC_ERR_OK && !m->failed)
        fail(m, "unicorn: %s (HardFault)", m->config.unicorn.strerror(error));
}
