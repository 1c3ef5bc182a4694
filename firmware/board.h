/* Clock tree, pins, interrupt priorities and the core's own timer. */
#ifndef BOARD_H
#define BOARD_H

#include <stdbool.h>
#include <stdint.h>

#include "stm32f401.h"
#include "wiring.h"

#define CYCLES_PER_CLOCK (CLOCK_HZ / MASTER_CLOCK_HZ)
#define TICK_US 500u /* of SysTick */
#define TICK_CYCLES (CLOCK_HZ / 1000000u * TICK_US)

/* 0 is the most urgent. After the thesis's table 4.2, with what it does not have below. */
enum priority {
    PRIORITY_ICG = 0,  /* TIM5: 4 us from the edge until the ADC's timer must be armed; sync */
    PRIORITY_ADC = 1,  /* DMA2: a frame is complete, its checksum is */
    PRIORITY_LINK = 2, /* DMA1 and the edges of SCK */
    PRIORITY_SH = 3,   /* TIM2 */
    PRIORITY_TICK = 4, /* SysTick: has a transfer stopped? */
};

/* Each is where its peripheral is looked after. */
void SysTick_Handler(void);
void DMA1_Stream3_IRQHandler(void);
void TIM2_IRQHandler(void);
void EXTI1_IRQHandler(void);
void EXTI15_10_IRQHandler(void);
void TIM5_IRQHandler(void);
void DMA2_Stream0_IRQHandler(void);
void DMA2_Stream1_IRQHandler(void);

void clock_init(void); /* uses no variables */
void board_init(void);
void irq_enable(enum irq irq, enum priority priority);

/* Nothing interrupts between the two; they nest. Keep it below 4 us: see PRIORITY_ICG. */
static inline uint32_t irq_save(void)
{
    uint32_t masked;
    __asm__ volatile("mrs %0, primask\n\tcpsid i" : "=r"(masked)::"memory");
    return masked;
}

static inline void irq_restore(uint32_t masked)
{
    __asm__ volatile("msr primask, %0" ::"r"(masked) : "memory");
}

static inline void pin_high(struct gpio *port, uint32_t pin)
{
    port->BSRR = 1u << pin;
}

static inline void pin_low(struct gpio *port, uint32_t pin)
{
    port->BSRR = 1u << (pin + 16u);
}

/* Memory that DMA reads is written, memory that it wrote is read again: to the compiler both look
 * untouched. */
static inline void dma_barrier(void)
{
    __asm__ volatile("" ::: "memory");
}

/* An address as the DMA controllers are told it. */
static inline uint32_t dma_address(const volatile void *location)
{
    return (uint32_t)(uintptr_t)location;
}

#endif
