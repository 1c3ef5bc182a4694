#include "board.h"

/* HSI 16 MHz / 8 = 2 MHz, * 168 = 336 MHz, / 4 = 84 MHz; / 7 = 48 MHz, which nothing uses */
#define PLL_M 8u
#define PLL_N 168u
#define PLL_P_DIV4 1u
#define PLL_Q 7u
_Static_assert(16000000u / PLL_M * PLL_N / 4u == CLOCK_HZ, "PLL");
#define FLASH_WAIT_STATES 2u /* above 60 MHz at 2.7 to 3.6 V */

/* The regulator's reset setting, scale 2, is the one for 84 MHz. */
void clock_init(void)
{
    FLASH->ACR = (FLASH_WAIT_STATES << FLASH_ACR_LATENCY) | FLASH_ACR_PRFTEN | FLASH_ACR_ICEN |
                 FLASH_ACR_DCEN;
    while ((FLASH->ACR >> FLASH_ACR_LATENCY & 7u) != FLASH_WAIT_STATES) {
    }
    RCC->PLLCFGR = (PLL_M << RCC_PLLCFGR_PLLM) | (PLL_N << RCC_PLLCFGR_PLLN) |
                   (PLL_P_DIV4 << RCC_PLLCFGR_PLLP) | (PLL_Q << RCC_PLLCFGR_PLLQ);
    RCC->CR |= RCC_CR_PLLON;
    while (!(RCC->CR & RCC_CR_PLLRDY)) {
    }
    /* APB1 at 42 MHz, its timers at 84; APB2 at 84 */
    RCC->CFGR = RCC_CFGR_PPRE1_DIV2 | RCC_CFGR_SW_PLL;
    while ((RCC->CFGR & RCC_CFGR_SWS) != RCC_CFGR_SWS_PLL) {
    }

    RCC->AHB1ENR = RCC_AHB1ENR_GPIOAEN | RCC_AHB1ENR_GPIOBEN | RCC_AHB1ENR_GPIOCEN |
                   RCC_AHB1ENR_CRCEN | RCC_AHB1ENR_DMA1EN | RCC_AHB1ENR_DMA2EN;
    RCC->APB1ENR = RCC_APB1ENR_TIM2EN | RCC_APB1ENR_TIM3EN | RCC_APB1ENR_TIM4EN |
                   RCC_APB1ENR_TIM5EN | RCC_APB1ENR_SPI2EN | RCC_APB1ENR_SPI3EN;
    RCC->APB2ENR = RCC_APB2ENR_ADC1EN | RCC_APB2ENR_SYSCFGEN;
    (void)RCC->APB2ENR; /* two cycles must pass before a peripheral is used */
}

enum pin_mode { PIN_INPUT, PIN_OUTPUT, PIN_ALTERNATE, PIN_ANALOG };
enum pin_speed { PIN_SLOW, PIN_MEDIUM, PIN_FAST };

static void pin_speed(struct gpio *port, uint32_t pin, enum pin_speed speed)
{
    port->OSPEEDR = (port->OSPEEDR & ~(3u << (2u * pin))) | ((uint32_t)speed << (2u * pin));
}

static void pin_mode(struct gpio *port, uint32_t pin, enum pin_mode mode)
{
    port->MODER = (port->MODER & ~(3u << (2u * pin))) | ((uint32_t)mode << (2u * pin));
}

static void pin_output(struct gpio *port, uint32_t pin)
{
    pin_mode(port, pin, PIN_OUTPUT);
}

static void pin_alternate(struct gpio *port, uint32_t pin, uint32_t function)
{
    reg *half = pin < 8u ? &port->AFRL : &port->AFRH;
    const uint32_t shift = 4u * (pin % 8u);
    *half = (*half & ~(0xFu << shift)) | (function << shift);
    pin_mode(port, pin, PIN_ALTERNATE);
}

static void pins_init(void)
{
    pin_high(CHAIN_ENABLE_PORT, CHAIN_ENABLE_PIN); /* dark before it is an output */
    pin_output(CHAIN_ENABLE_PORT, CHAIN_ENABLE_PIN);
    pin_output(CHAIN_LATCH_PORT, CHAIN_LATCH_PIN);
    pin_output(READY_PORT, READY_PIN);
    pin_output(HEARTBEAT_PORT, HEARTBEAT_PIN);
    for (uint32_t n = 0; n < LED_GPIO_COUNT; n++)
        pin_output(LED_PORT, LED_FIRST_PIN + n);

    pin_speed(FM_PORT, FM_PIN, PIN_MEDIUM);
    pin_speed(SH_PORT, SH_PIN, PIN_MEDIUM);
    pin_speed(ICG_PORT, ICG_PIN, PIN_MEDIUM);
    pin_speed(MISO_PORT, MISO_PIN, PIN_FAST);
    pin_speed(CHAIN_CLOCK_PORT, CHAIN_CLOCK_PIN, PIN_MEDIUM);
    pin_speed(CHAIN_DATA_PORT, CHAIN_DATA_PIN, PIN_MEDIUM);
    pin_speed(CHAIN_LATCH_PORT, CHAIN_LATCH_PIN, PIN_MEDIUM);
    pin_alternate(FM_PORT, FM_PIN, FM_AF);
    pin_alternate(ADC_CLOCK_PORT, ADC_CLOCK_PIN, ADC_CLOCK_AF);
    pin_alternate(SCLK_PORT, SCLK_PIN, SCLK_AF);
    pin_alternate(MISO_PORT, MISO_PIN, MISO_AF);
    pin_alternate(MOSI_PORT, MOSI_PIN, MOSI_AF);
    pin_alternate(CHAIN_CLOCK_PORT, CHAIN_CLOCK_PIN, CHAIN_CLOCK_AF);
    pin_alternate(CHAIN_DATA_PORT, CHAIN_DATA_PIN, CHAIN_DATA_AF);
    pin_alternate(SH_PORT, SH_PIN, SH_AF);
    pin_alternate(ICG_PORT, ICG_PIN, ICG_AF);
    pin_mode(OS_PORT, OS_PIN, PIN_ANALOG);
    SYNC_PORT->PUPDR |= 2u << (2u * SYNC_PIN); /* pulled down; an input from reset on */
}

void irq_enable(enum irq irq, enum priority priority)
{
    NVIC_IPR[irq] = (uint8_t)((uint32_t)priority << PRIORITY_SHIFT);
    NVIC_ISER[(uint32_t)irq / 32u] = 1u << ((uint32_t)irq % 32u);
}

void board_init(void)
{
    pins_init();
    SCB_SHPR3 = (uint32_t)PRIORITY_TICK << (SCB_SHPR3_SYSTICK + PRIORITY_SHIFT);
    SYSTICK->LOAD = TICK_CYCLES - 1u;
    SYSTICK->VAL = 0;
    SYSTICK->CTRL = SYSTICK_CTRL_CLKSOURCE | SYSTICK_CTRL_TICKINT | SYSTICK_CTRL_ENABLE;
}
