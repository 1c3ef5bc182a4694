/* Clocks and resets (RCC), and the little of FLASH and PWR that goes with them. */
#include "machine.h"

#define RCC 0x40023800u
#define FLASH_REGISTERS 0x40023C00u
#define PWR 0x40007000u
#define PLL_LOCK_TICKS (TICKS_PER_SECOND / 10000) /* 100 us */

/* Clock tree by index (offset in AHB1ENR's numbering) / 4: AHB1 0, AHB2 1, APB1 4, APB2 5. */
struct gate {
    uint32_t block;
    uint8_t bus, bit;
};

static const struct gate gates[] = {
    {0x40000000u, 3, 0},  {0x40000400u, 3, 1},  {0x40000800u, 3, 2},  {0x40000C00u, 3, 3},
    {0x40003800u, 3, 14}, {0x40003C00u, 3, 15}, {PWR, 3, 28},         {0x40012000u, 4, 8},
    {0x40013800u, 4, 14}, {0x40020000u, 0, 0},  {0x40020400u, 0, 1},  {0x40020800u, 0, 2},
    {0x40020C00u, 0, 3},  {0x40021000u, 0, 4},  {0x40021C00u, 0, 7},  {0x40023000u, 0, 12},
    {0x40026000u, 0, 21}, {0x40026400u, 0, 22},
};

/* What the bits may be: AHB1, AHB2, -, APB1, APB2. */
static const uint32_t gate_bits[5] = {0x0060109Fu, 0, 0, 0x1000C00Fu, 0x00004100u};

static const struct gate *gate_of(uint32_t address) {
    for (size_t i = 0; i < sizeof gates / sizeof gates[0]; i++)
        if (gates[i].block == (address & ~0x3FFu)) return &gates[i];
    return NULL;
}

/* EXTI works without a clock; what is not in the list is always clocked or not modelled. */
bool rcc_clocked(const struct machine *m, uint32_t address) {
    const struct gate *g = gate_of(address);
    return !g || ((m->rcc.enr[g->bus] >> g->bit) & 1);
}

bool rcc_held(const struct machine *m, uint32_t address) {
    const struct gate *g = gate_of(address);
    return g && ((m->rcc.rstr[g->bus] >> g->bit) & 1);
}

static void set_clocks(struct machine *m, uint32_t cpu) {
    static const uint8_t shift[8] = {0, 0, 0, 0, 1, 2, 3, 4};
    struct rcc *r = &m->rcc;
    uint32_t apb1 = shift[(r->cfgr >> 10) & 7], apb2 = shift[(r->cfgr >> 13) & 7];
    uint32_t count = cycle_counter(m);
    r->cpu = cpu;
    r->apb1 = cpu << apb1;
    r->apb2 = cpu << apb2;
    r->timers = apb1 ? r->apb1 / 2 : r->apb1;
    r->grid = m->now;
    m->nvic.cycles_offset += count - cycle_counter(m);
    if (r->apb1 < 8) fail(m, "APB1 would run above 42 MHz");
    if (r->cpu < 4) fail(m, "the core would run above 84 MHz");
}

void rcc_reset(struct machine *m) {
    m->rcc = (struct rcc){.cr = 0x83, .pllcfgr = 0x24003010u, .csr = 0x0E000000u};
    m->rcc.pwr_cr = 0x8000u;
    m->rcc.pll_ready = NEVER;
    m->rcc.lpenr[0] = 0x0061900Fu;
    m->rcc.lpenr[3] = 0x10E2C80Fu;
    m->rcc.lpenr[4] = 0x00077930u;
    set_clocks(m, 21);
    /* HCLK has no relation to the ticks of 84 MHz yet */
}

/* Ticks of a cycle of the PLL's output, 0 after a complaint. */
static uint32_t pll_cycle(struct machine *m) {
    uint32_t c = m->rcc.pllcfgr;
    uint32_t M = c & 63, N = (c >> 6) & 511, P = 2 * ((c >> 16) & 3) + 2;
    if (c & (1u << 22)) {
        fail(m, "RCC_PLLCFGR: the board has no HSE crystal");
        return 0;
    }
    if (M < 2 || N < 50) {
        fail(m, "RCC_PLLCFGR: PLLM %u or PLLN %u out of range", M, N);
        return 0;
    }
    uint64_t input = 16000000u / M;
    uint64_t vco = 16000000ull * N / M;
    if (input < 950000 || input > 2000000 || vco < 100000000 || vco > 432000000) {
        fail(m, "RCC_PLLCFGR: VCO at %.3f MHz from %.3f MHz is out of range", (double)vco / 1e6,
             (double)input / 1e6);
        return 0;
    }
    uint64_t output = vco / P;
    if (!output || TICKS_PER_SECOND % output) {
        fail(m, "RCC_PLLCFGR: %.3f MHz does not divide 336 MHz: not modelled", (double)output / 1e6);
        return 0;
    }
    return (uint32_t)(TICKS_PER_SECOND / output);
}

static void check_latency(struct machine *m) {
    uint32_t megahertz = 336 / m->rcc.cpu; /* 2.7 to 3.6 V: a wait state for each 30 MHz */
    if ((m->rcc.flash_acr & 0xF) < (megahertz - 1) / 30)
        fail(m, "FLASH_ACR: %u wait states are too few at %u MHz", m->rcc.flash_acr & 0xF,
             megahertz);
}

static void switch_clock(struct machine *m) {
    uint32_t cfgr = m->rcc.cfgr, cycle = 21;
    if (tim_running(m)) {
        fail(m, "RCC_CFGR: a clock change while timers run is not modelled");
        return;
    }
    if ((cfgr & 3) == 2) {
        if (!(m->rcc.cr & (1u << 25))) {
            fail(m, "RCC_CFGR: the PLL is not ready");
            return;
        }
        cycle = pll_cycle(m);
        if (!cycle) return;
        /* from here on everything falls on the ticks of 84 MHz */
        m->now += (TICKS_PER_CYCLE - m->now % TICKS_PER_CYCLE) % TICKS_PER_CYCLE;
    } else if ((cfgr & 3) != 0) {
        fail(m, "RCC_CFGR: the board has no HSE crystal");
        return;
    }
    m->rcc.cfgr = (cfgr & ~0xCu) | (cfgr & 3) << 2;
    set_clocks(m, cycle);
    check_latency(m);
}

void rcc_event(struct machine *m, uint64_t time) {
    (void)time;
    if (m->rcc.cr & (1u << 24)) m->rcc.cr |= 1u << 25;
}

static void reset_devices(struct machine *m, unsigned bus, uint32_t rising) {
    for (size_t i = 0; i < sizeof gates / sizeof gates[0]; i++) {
        uint32_t block = gates[i].block;
        if (gates[i].bus != bus || !((rising >> gates[i].bit) & 1)) continue;
        unsigned port = (block - 0x40020000u) / 0x400;
        if (block < 0x40001000u)
            tim_reset(m, (block >> 10) & 3);
        else if (block == 0x40003800u || block == 0x40003C00u)
            spi_reset(m, (block >> 10) & 1);
        else if (block == 0x40012000u)
            adc_reset(m);
        else if (block == 0x40013800u)
            syscfg_reset(m);
        else if (block == 0x40023000u)
            crc_reset(m);
        else if (block == 0x40026000u || block == 0x40026400u)
            dma_reset(m, (block >> 10) & 1);
        else if (block == PWR)
            m->rcc.pwr_cr = 0x8000u;
        else if (block >= 0x40020000u && port < PORTS)
            gpio_reset(m, port, m->now);
    }
}

uint32_t rcc_read(struct machine *m, uint32_t address) {
    struct rcc *r = &m->rcc;
    if (address == FLASH_REGISTERS) return r->flash_acr;
    if (address == PWR) return r->pwr_cr;
    if (address == PWR + 4) return 0x4000u; /* CSR: VOSRDY */
    uint32_t offset = address - RCC;
    switch (offset) {
    case 0x00: return r->cr;
    case 0x04: return r->pllcfgr;
    case 0x08: return r->cfgr;
    case 0x0C: return r->cir;
    case 0x10: case 0x14: case 0x20: case 0x24:
        return r->rstr[offset < 0x20 ? (offset - 0x10) / 4 : (offset - 0x20) / 4 + 3];
    case 0x30: case 0x34: case 0x40: case 0x44:
        return r->enr[offset < 0x40 ? (offset - 0x30) / 4 : (offset - 0x40) / 4 + 3];
    case 0x50: case 0x54: case 0x60: case 0x64:
        return r->lpenr[offset < 0x60 ? (offset - 0x50) / 4 : (offset - 0x60) / 4 + 3];
    case 0x74: return r->csr;
    case 0x8C: return r->dckcfgr;
    default: fail(m, "%s is not modelled", register_name(m, address)); return 0;
    }
}

static void write_reset(struct machine *m, uint32_t address, unsigned bus, uint32_t value) {
    if (!allowed_bits(m, address, value, gate_bits[bus])) return;
    uint32_t rising = value & ~m->rcc.rstr[bus];
    m->rcc.rstr[bus] = value;
    reset_devices(m, bus, rising);
}

static void write_enable(struct machine *m, uint32_t address, unsigned bus, uint32_t value) {
    if (!allowed_bits(m, address, value, gate_bits[bus])) return;
    uint32_t falling = m->rcc.enr[bus] & ~value;
    if (falling & ~(bus == 0 ? 0x1000u : 0u)) {
        fail(m, "%s: switching a clock off is not modelled", register_name(m, address));
        return;
    }
    m->rcc.enr[bus] = value;
}

void rcc_write(struct machine *m, uint32_t address, uint32_t value) {
    struct rcc *r = &m->rcc;
    if (address == FLASH_REGISTERS) {
        if (!allowed_bits(m, address, value, 0x1F0F)) return;
        r->flash_acr = value & ~0x1800u;
        check_latency(m);
        return;
    }
    if (address == PWR) {
        if (allowed_bits(m, address, value, 0xC000)) r->pwr_cr = value;
        if ((r->pwr_cr >> 14) < 2 && r->cpu < 6) fail(m, "PWR_CR: VOS too low for the clock");
        return;
    }
    uint32_t offset = address - RCC;
    switch (offset) {
    case 0x00: {
        if (!allowed_bits(m, address, value & ~0x0200FF02u, 0x010000F9u)) return;
        if (!(value & 1)) fail(m, "RCC_CR: running without HSI is not modelled");
        bool on = (value >> 24) & 1, was = (r->cr >> 24) & 1;
        if (was && !on && (r->cfgr & 0xC) == 8) fail(m, "RCC_CR: the PLL that clocks the core");
        if (on && !was) {
            if (!pll_cycle(m)) return;
            machine_schedule(m, EVENT_RCC, m->now + PLL_LOCK_TICKS);
        }
        r->cr = (r->cr & (on ? 0x02000000u : 0)) | (value & 0x010000F8u) | 3u;
        break;
    }
    case 0x04:
        if (r->cr & (1u << 24))
            fail(m, "RCC_PLLCFGR may change only while the PLL is off");
        else if (allowed_bits(m, address, value, 0x2F437FFFu))
            r->pllcfgr = value;
        break;
    case 0x08: {
        if (!allowed_bits(m, address, value & ~0xCu, 0x0000FCF3u)) return;
        if (value & 0x80u) {
            fail(m, "RCC_CFGR: an AHB prescaler is not modelled");
            return;
        }
        uint32_t before = r->cfgr;
        r->cfgr = (before & 0xCu) | (value & ~0xCu);
        if ((before ^ r->cfgr) & 0xFC03u) switch_clock(m);
        break;
    }
    case 0x10: case 0x14: write_reset(m, address, (offset - 0x10) / 4, value); break;
    case 0x20: case 0x24: write_reset(m, address, (offset - 0x20) / 4 + 3, value); break;
    case 0x30: case 0x34: write_enable(m, address, (offset - 0x30) / 4, value); break;
    case 0x40: case 0x44: write_enable(m, address, (offset - 0x40) / 4 + 3, value); break;
    case 0x74:
        if (allowed_bits(m, address, value & 0x00FFFFFFu, 0) && (value & (1u << 24))) r->csr = 0;
        break;
    default: fail(m, "%s is not modelled", register_name(m, address));
    }
}
