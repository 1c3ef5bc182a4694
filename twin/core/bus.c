/* Addresses: which peripheral, whether it is clocked, what its registers are called. */
#include <stdio.h>
#include <string.h>

#include "machine.h"

struct device {
    uint32_t base;
    const char *name;
    const char *registers; /* names by word, separated by blanks; - is reserved */
};

#define TIM_REGISTERS \
    "CR1 CR2 SMCR DIER SR EGR CCMR1 CCMR2 CCER CNT PSC ARR RCR CCR1 CCR2 CCR3 CCR4 BDTR DCR DMAR OR"
#define SPI_REGISTERS "CR1 CR2 SR DR CRCPR RXCRCR TXCRCR I2SCFGR I2SPR"
#define GPIO_REGISTERS "MODER OTYPER OSPEEDR PUPDR IDR ODR BSRR LCKR AFRL AFRH"
#define DMA_REGISTERS \
    "LISR HISR LIFCR HIFCR S0CR S0NDTR S0PAR S0M0AR S0M1AR S0FCR S1CR S1NDTR S1PAR S1M0AR S1M1AR " \
    "S1FCR S2CR S2NDTR S2PAR S2M0AR S2M1AR S2FCR S3CR S3NDTR S3PAR S3M0AR S3M1AR S3FCR S4CR " \
    "S4NDTR S4PAR S4M0AR S4M1AR S4FCR S5CR S5NDTR S5PAR S5M0AR S5M1AR S5FCR S6CR S6NDTR S6PAR " \
    "S6M0AR S6M1AR S6FCR S7CR S7NDTR S7PAR S7M0AR S7M1AR S7FCR"

static const struct device devices[] = {
    {0x40000000u, "TIM2", TIM_REGISTERS},
    {0x40000400u, "TIM3", TIM_REGISTERS},
    {0x40000800u, "TIM4", TIM_REGISTERS},
    {0x40000C00u, "TIM5", TIM_REGISTERS},
    {0x40003800u, "SPI2", SPI_REGISTERS},
    {0x40003C00u, "SPI3", SPI_REGISTERS},
    {0x40007000u, "PWR", "CR CSR"},
    {0x40012000u, "ADC1",
     "SR CR1 CR2 SMPR1 SMPR2 JOFR1 JOFR2 JOFR3 JOFR4 HTR LTR SQR1 SQR2 SQR3 JSQR JDR1 JDR2 JDR3 "
     "JDR4 DR"},
    {0x40013800u, "SYSCFG", "MEMRMP PMC EXTICR1 EXTICR2 EXTICR3 EXTICR4 - - CMPCR"},
    {0x40013C00u, "EXTI", "IMR EMR RTSR FTSR SWIER PR"},
    {0x40020000u, "GPIOA", GPIO_REGISTERS},
    {0x40020400u, "GPIOB", GPIO_REGISTERS},
    {0x40020800u, "GPIOC", GPIO_REGISTERS},
    {0x40020C00u, "GPIOD", GPIO_REGISTERS},
    {0x40021000u, "GPIOE", GPIO_REGISTERS},
    {0x40021C00u, "GPIOH", GPIO_REGISTERS},
    {0x40023000u, "CRC", "DR IDR CR"},
    {0x40023800u, "RCC",
     "CR PLLCFGR CFGR CIR AHB1RSTR AHB2RSTR - - APB1RSTR APB2RSTR - - AHB1ENR AHB2ENR - - APB1ENR "
     "APB2ENR - - AHB1LPENR AHB2LPENR - - APB1LPENR APB2LPENR - - BDCR CSR - - SSCGR PLLI2SCFGR - "
     "DCKCFGR"},
    {0x40023C00u, "FLASH", "ACR KEYR OPTKEYR SR CR OPTCR"},
    {0x40026000u, "DMA1", DMA_REGISTERS},
    {0x40026400u, "DMA2", DMA_REGISTERS},
    {0xE0001000u, "DWT", "CTRL CYCCNT"},
};

/* Found anew at every call: only for complaints. */
const char *register_name(struct machine *m, uint32_t address) {
    char *name = m->name;
    for (size_t i = 0; i < sizeof devices / sizeof devices[0]; i++) {
        const struct device *d = &devices[i];
        if (address - d->base >= 0x400) continue;
        const char *word = d->registers;
        for (uint32_t n = (address - d->base) / 4; n && word; n--) {
            word = strchr(word, ' ');
            if (word) word++;
        }
        if (address == 0x40012304u) word = "CCR";
        if (word && *word && *word != '-')
            (void)snprintf(name, sizeof m->name, "%s_%.*s", d->name, (int)strcspn(word, " "), word);
        else
            (void)snprintf(name, sizeof m->name, "%s+0x%02X", d->name, address - d->base);
        return name;
    }
    (void)snprintf(name, sizeof m->name, "register 0x%08X", address);
    return name;
}

bool allowed_bits(struct machine *m, uint32_t address, uint32_t value, uint32_t allowed) {
    if (!(value & ~allowed)) return true;
    fail(m, "%s: bits 0x%08X are not modelled", register_name(m, address), value & ~allowed);
    return false;
}

static int gpio_port(uint32_t block) {
    unsigned port = (block - 0x40020000u) / 0x400;
    return block >= 0x40020000u && (port <= 4 || port == 7) ? (int)port : -1;
}

static bool ready(struct machine *m, uint32_t address) {
    if (!rcc_clocked(m, address)) {
        fail(m, "%s: its clock is not enabled in RCC", register_name(m, address));
        return false;
    }
    if (rcc_held(m, address)) {
        fail(m, "%s: RCC holds it in reset", register_name(m, address));
        return false;
    }
    return true;
}

static uint32_t read_word(struct machine *m, uint32_t address) {
    uint32_t block = address & ~0x3FFu, offset = address & 0x3FFu;
    if (!ready(m, address)) return 0;
    switch (block) {
    case 0x40000000u:
    case 0x40000400u:
    case 0x40000800u:
    case 0x40000C00u: return tim_read(m, (block >> 10) & 3, offset);
    case 0x40003800u:
    case 0x40003C00u: return spi_read(m, (block >> 10) & 1, offset);
    case 0x40007000u:
    case 0x40023C00u:
    case 0x40023800u: return rcc_read(m, address);
    case 0x40012000u: return adc_read(m, offset);
    case 0x40013800u: return exti_read(m, offset | 0x1000u);
    case 0x40013C00u: return exti_read(m, offset);
    case 0x40023000u: return crc_read(m, offset);
    case 0x40026000u:
    case 0x40026400u: return dma_read(m, (block >> 10) & 1, offset);
    default:
        if (gpio_port(block) >= 0) return gpio_read(m, (unsigned)gpio_port(block), offset);
        fail(m, "%s is not modelled", register_name(m, address));
        return 0;
    }
}

static void write_word(struct machine *m, uint32_t address, uint32_t value) {
    uint32_t block = address & ~0x3FFu, offset = address & 0x3FFu;
    if (!ready(m, address)) return;
    switch (block) {
    case 0x40000000u:
    case 0x40000400u:
    case 0x40000800u:
    case 0x40000C00u: tim_write(m, (block >> 10) & 3, offset, value); break;
    case 0x40003800u:
    case 0x40003C00u: spi_write(m, (block >> 10) & 1, offset, value); break;
    case 0x40007000u:
    case 0x40023C00u:
    case 0x40023800u: rcc_write(m, address, value); break;
    case 0x40012000u: adc_write(m, offset, value); break;
    case 0x40013800u: exti_write(m, offset | 0x1000u, value); break;
    case 0x40013C00u: exti_write(m, offset, value); break;
    case 0x40023000u: crc_write(m, offset, value); break;
    case 0x40026000u:
    case 0x40026400u: dma_write(m, (block >> 10) & 1, offset, value); break;
    default:
        if (gpio_port(block) >= 0)
            gpio_write(m, (unsigned)gpio_port(block), offset, value);
        else
            fail(m, "%s is not modelled", register_name(m, address));
    }
}

static uint8_t *memory(const struct machine *m, uint32_t address, unsigned size, bool write) {
    if (address - RAM_BASE <= RAM_SIZE - size) return m->ram + (address - RAM_BASE);
    if (!write && address - FLASH_BASE <= FLASH_SIZE - size)
        return m->flash + (address - FLASH_BASE);
    return NULL;
}

/* Memory and registers alike: what DMA sees. */
uint32_t bus_read(struct machine *m, uint32_t address, unsigned size) {
    const uint8_t *from = memory(m, address, size, false);
    uint32_t value = 0;
    if (from) {
        memcpy(&value, from, size);
        return value;
    }
    if (address % size || (address & 0xFFF80000u) != 0x40000000u) {
        fail(m, "DMA reads 0x%08X", address);
        return 0;
    }
    value = read_word(m, address & ~3u) >> (8 * (address & 3u));
    return size == 4 ? value : value & ((1u << (8 * size)) - 1u);
}

void bus_write(struct machine *m, uint32_t address, unsigned size, uint32_t value) {
    uint8_t *to = memory(m, address, size, true);
    if (to) {
        memcpy(to, &value, size);
        return;
    }
    if (address % size || (address & 0xFFF80000u) != 0x40000000u) {
        fail(m, "DMA writes to 0x%08X", address);
        return;
    }
    (void)bus_mmio_write(NULL, address - PERIPHERALS, size, value, m);
}

uint64_t bus_mmio_read(uc_engine *uc, uint64_t offset, unsigned size, void *user) {
    struct machine *m = user;
    uint32_t address = PERIPHERALS + (uint32_t)offset;
    (void)uc;
    if (m->failed) return 0;
    if (size > 4 || address % size) {
        fail(m, "unaligned read of %s", register_name(m, address));
        return 0;
    }
    uint32_t value = read_word(m, address & ~3u) >> (8 * (address & 3u));
    return size == 4 ? value : value & ((1u << (8 * size)) - 1u);
}

/* Narrow writes: where the hardware takes them and the meaning is clear. */
static bool narrow(uint32_t address, unsigned size, uint32_t *value) {
    uint32_t block = address & ~0x3FFu, offset = address & 0x3FFu;
    if (block == 0x40003800u || block == 0x40003C00u) return offset == 0x0C || size == 2;
    if (block < 0x40001000u) return size == 2 && !(offset & 2);
    if (block >= 0x40020000u && block < 0x40022000u && size == 2 && (offset & ~3u) == 0x18) {
        if (offset & 2) *value <<= 16;
        return true;
    }
    return false;
}

void bus_mmio_write(uc_engine *uc, uint64_t offset, unsigned size, uint64_t value, void *user) {
    struct machine *m = user;
    uint32_t address = PERIPHERALS + (uint32_t)offset;
    uint32_t word = (uint32_t)value;
    (void)uc;
    if (m->failed) return;
    if (size > 4 || address % size)
        fail(m, "unaligned write to %s", register_name(m, address));
    else if (size < 4 && !narrow(address, size, &word))
        fail(m, "%u-bit write to %s is not modelled", 8 * size, register_name(m, address));
    else
        write_word(m, address & ~3u, word);
}

uint64_t bus_system_read(uc_engine *uc, uint64_t offset, unsigned size, void *user) {
    struct machine *m = user;
    uint32_t address = SYSTEM + (uint32_t)offset;
    (void)uc;
    if (m->failed) return 0;
    if (size > 4 || address % size) {
        fail(m, "unaligned read of %s", register_name(m, address));
        return 0;
    }
    uint32_t value = nvic_read(m, address & ~3u) >> (8 * (address & 3u));
    return size == 4 ? value : value & ((1u << (8 * size)) - 1u);
}

void bus_system_write(uc_engine *uc, uint64_t offset, unsigned size, uint64_t value, void *user) {
    struct machine *m = user;
    uint32_t address = SYSTEM + (uint32_t)offset;
    (void)uc;
    if (m->failed) return;
    if (size > 4 || address % size)
        fail(m, "unaligned write to %s", register_name(m, address));
    else
        nvic_write(m, address, size, (uint32_t)value);
}
