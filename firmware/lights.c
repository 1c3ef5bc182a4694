#include "lights.h"

#include "board.h"

#define LED_MASK ((1u << LED_GPIO_COUNT) - 1u)
#define CHAIN_STREAM (&DMA1->stream[5]) /* channel 0: SPI3_TX */
#define CHAIN_FLAGS (DMA_ISR_ALL << 6)
/* The interrupt comes so many clocks before a step and waits for it, so that its own delay, which
 * varies, does not shorten the exposure. */
#define EARLY 10u

static const struct plan *plan;
static uint32_t next_step, end_step; /* of this period */
static uint64_t chain_bytes;         /* as they are shifted, read by DMA */
static uint64_t chain_pattern;       /* shifted in already */

void lights_init(void)
{
    /* 10.5 MHz: 64 bits take 6.1 us, LED_CHAIN_STEP is 10 us */
    SPI3->CR2 = SPI_CR2_TXDMAEN;
    SPI3->CR1 = SPI_CR1_MSTR | SPI_CR1_SSM | SPI_CR1_SSI | SPI_CR1_BR_DIV4 | SPI_CR1_SPE;
    CHAIN_STREAM->PAR = dma_address(&SPI3->DR);
    CHAIN_STREAM->M0AR = dma_address(&chain_bytes);
    chain_pattern = ~0ull; /* unknown: no plan has it, as the outputs after channel 63 stay empty */
}

static void chain_wait(void)
{
    while ((CHAIN_STREAM->CR & DMA_CR_EN) || (SPI3->SR & (SPI_SR_TXE | SPI_SR_BSY)) != SPI_SR_TXE) {
    }
}

/* The pattern shows at the next latch. The last chip's last output is shifted first. */
static void chain_shift(uint64_t leds)
{
    const uint64_t pattern = leds >> LED_CHAIN_FIRST;
    if (pattern == chain_pattern)
        return;
    chain_wait();
    chain_pattern = pattern;
    chain_bytes = __builtin_bswap64(pattern);
    dma_barrier();
    DMA1->HIFCR = CHAIN_FLAGS;
    CHAIN_STREAM->NDTR = sizeof chain_bytes;
    CHAIN_STREAM->CR = DMA_CR_DIR_TO_PERIPHERAL | DMA_CR_MINC | DMA_CR_EN;
}

void lights_off(void)
{
    LED_PORT->BSRR = LED_MASK << (LED_FIRST_PIN + 16u);
    pin_high(CHAIN_ENABLE_PORT, CHAIN_ENABLE_PIN);
}

void lights_on(uint64_t leds)
{
    LED_PORT->BSRR = ((uint32_t)leds & LED_MASK) << LED_FIRST_PIN;
}

void lights_none(void)
{
    TIM5->DIER &= ~TIM_DIER_CC2IE;
    next_step = end_step = 0;
}

uint64_t lights_plan(const struct plan *new_plan, uint32_t frame)
{
    plan = new_plan;
    next_step = plan->first_step[frame];
    end_step = plan->first_step[frame + 1u];
    if (next_step == end_step) {
        lights_none();
        return 0;
    }
    const struct step *first = &plan->steps[next_step];
    const uint32_t latch = first->latch ? next_step : first->next_latch;
    if (latch != NO_STEP)
        chain_shift(plan->steps[latch].leds);
    const uint64_t leds = plan->steps[end_step - 1u].leds; /* those of all steps */
    TIM5->DIER |= TIM_DIER_CC2IE;
    lights_step();
    return leds;
}

void lights_step(void)
{
    while (next_step < end_step) {
        const struct step *step = &plan->steps[next_step];
        const uint32_t early = step->tick > EARLY ? step->tick - EARLY : 0;
        TIM5->CCR2 = early;
        /* a compare already passed does not come: look, after it was set */
        if (TIM5->CNT < early)
            return;
        next_step++;
        if (step->latch) {
            /* Only a step within 7 us of the pattern's predecessor finds it unfinished. */
            chain_shift(step->leds);
            chain_wait();
        }
        while (TIM5->CNT < step->tick && !(TIM5->SR & TIM_SR_UIF)) {
        }
        lights_on(step->leds);
        if (step->latch) {
            pin_high(CHAIN_LATCH_PORT, CHAIN_LATCH_PIN);
            pin_low(CHAIN_ENABLE_PORT, CHAIN_ENABLE_PIN);
            pin_low(CHAIN_LATCH_PORT, CHAIN_LATCH_PIN);
            chain_shift(plan->steps[step->next_latch].leds);
        }
    }
    lights_none();
}
