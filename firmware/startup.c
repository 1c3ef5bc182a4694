/* Vectors, and what must happen before main. Names of handlers are CMSIS's. */
#include <stddef.h>
#include <stdint.h>

#include "board.h"
#include "lights.h"

extern uint32_t stack_top[], data_load[], data_start[], data_end[], bss_start[], bss_end[];

int main(void);
void Reset_Handler(void);
void Default_Handler(void);

struct vectors {
    uint32_t *stack;
    void (*exception[15])(void);
    void (*irq[IRQ_COUNT])(void);
};

#define UNUSED(first, last) [first... last] = Default_Handler

__attribute__((section(".vectors"), used)) static const struct vectors vectors = {
    .stack = stack_top,
    .exception = {Reset_Handler, Default_Handler, Default_Handler, Default_Handler, Default_Handler,
                  Default_Handler, NULL, NULL, NULL, NULL, Default_Handler, Default_Handler, NULL,
                  Default_Handler, SysTick_Handler},
    .irq = {UNUSED(0, IRQ_EXTI1 - 1),
            [IRQ_EXTI1] = EXTI1_IRQHandler,
            UNUSED(IRQ_EXTI1 + 1, IRQ_DMA1_STREAM3 - 1),
            [IRQ_DMA1_STREAM3] = DMA1_Stream3_IRQHandler,
            UNUSED(IRQ_DMA1_STREAM3 + 1, IRQ_TIM2 - 1),
            [IRQ_TIM2] = TIM2_IRQHandler,
            UNUSED(IRQ_TIM2 + 1, IRQ_EXTI15_10 - 1),
            [IRQ_EXTI15_10] = EXTI15_10_IRQHandler,
            UNUSED(IRQ_EXTI15_10 + 1, IRQ_TIM5 - 1),
            [IRQ_TIM5] = TIM5_IRQHandler,
            UNUSED(IRQ_TIM5 + 1, IRQ_DMA2_STREAM0 - 1),
            [IRQ_DMA2_STREAM0] = DMA2_Stream0_IRQHandler,
            [IRQ_DMA2_STREAM1] = DMA2_Stream1_IRQHandler,
            UNUSED(IRQ_DMA2_STREAM1 + 1, IRQ_COUNT - 1)},
};

void Reset_Handler(void)
{
    clock_init(); /* first: the rest is five times as fast then */
    const uint32_t *from = data_load;
    for (uint32_t *to = data_start; to < data_end; to++)
        *to = *from++;
    for (uint32_t *to = bss_start; to < bss_end; to += 4) /* 70 KB: four by four saves 0.4 ms */
        to[0] = to[1] = to[2] = to[3] = 0;
    main();
}

/* A fault, or an interrupt nobody asked for: dark, and the heartbeat stops. */
void Default_Handler(void)
{
    __asm__ volatile("cpsid i");
    lights_off();
    for (;;) {
    }
}

typedef uint32_t __attribute__((may_alias)) word;

/* What compilers call where C says nothing of a call. */
void *memcpy(void *restrict to, const void *restrict from, size_t size);
void *memset(void *to, int value, size_t size);

void *memcpy(void *restrict to, const void *restrict from, size_t size)
{
    uint8_t *target = to;
    const uint8_t *source = from;
    size_t n = 0;
    if (!(((uintptr_t)to | (uintptr_t)from) & 3u)) /* which it is: structures */
        for (; n + 4u <= size; n += 4u)
            *(word *)(target + n) = *(const word *)(source + n);
    for (; n < size; n++)
        target[n] = source[n];
    return to;
}

void *memset(void *to, int value, size_t size)
{
    uint8_t *target = to;
    size_t n = 0;
    if (!((uintptr_t)to & 3u))
        for (; n + 4u <= size; n += 4u)
            *(word *)(target + n) = 0x01010101u * (uint8_t)value;
    for (; n < size; n++)
        target[n] = (uint8_t)value;
    return to;
}
