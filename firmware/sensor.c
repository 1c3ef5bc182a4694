/* How time passes. TIM2 and TIM5 count master clocks (84 MHz / 21) and are started by the same
 * update of TIM3, which makes fM: so ICG's edges keep their phase to fM, and SH follows ICG by one
 * clock. In clocks after TIM5's update, seen by the sensor, whose signals are inverted:
 *
 *    0  ICG falls; TIM5's interrupt arms TIM4
 *    1  SH rises
 *    9  SH falls: the integration ends, and stream mode's LEDs go out
 *   19  TIM2's trigger starts TIM4
 *   20  ICG rises: element 0 is on OS, each for 4 clocks
 *
 * TIM4 triggers the ADC once per element, its counter and the ADC's clock divide the same 84 MHz:
 * no jitter. After the last element DMA interrupts, and TIM4 is stopped. */
#include "sensor.h"

#include "board.h"
#include "frames.h"
#include "lights.h"
#include "link.h"

#define ELEMENT_CYCLES (CLOCKS_PER_ELEMENT * CYCLES_PER_CLOCK)

/* SH's counter at which TIM4 starts: late, so that TIM5's interrupt has the time to arm it, but
 * before ICG rises. */
#define ADC_START 18u
#define ADC_START_CLOCK (ADC_START + SH_DELAY - ICG_DELAY)
/* The ADC samples for 3 of its cycles, then holds. That comes when 60 of an element's 84 cycles are
 * over: the output has settled, and conversion ends before the next sample. */
#define ADC_HOLD 60u
#define ADC_SAMPLING 12u /* 3 cycles of 84 MHz / 4 */
#define TRIGGER_DELAY 2u /* from TIM2's trigger to TIM4's counting */
#define ADC_TRIGGER                                                                                \
    ((ICG_PULSE - ADC_START_CLOCK) * CYCLES_PER_CLOCK + ADC_HOLD - ADC_SAMPLING - TRIGGER_DELAY)
_Static_assert(ADC_TRIGGER > 0 && ADC_TRIGGER < ELEMENT_CYCLES, "in TIM4's period");

/* With less time than this between read-outs, the ADC never stops: DMA counts the conversions of
 * one ICG period and changes buffers. Otherwise there is time to stop and arm it by interrupt. */
#define SEAMLESS_MAX (ICG_MIN + CLOCKS_PER_ELEMENT * (SPARE_ELEMENTS + 2u) + 3u)
/* TIM5's third compare: TIM2's trigger of this read-out is over, that of the next SH not yet. */
#define RESYNCED 24u
_Static_assert(RESYNCED > ADC_START_CLOCK && RESYNCED < SH_MIN, "between two triggers");

#define SYNC_LINE (1u << SYNC_PIN)
#define ADC_STREAM (&DMA2->stream[0]) /* channel 0: ADC1 */
#define TIM4_FROM_TIM2 TIM_SMCR_TS_ITR1

#define BOOT_ICG 30000u
#define BOOT_SH 100u
#define LEAD_EDGES 2u   /* after the flush: the second begins the first exposure */
#define LIT_SH_PULSES 5u /* original mode: LEDs go on so many SH edges before the read-out */

enum phase { IDLE, AWAIT, FLUSH, LEAD, READ };

struct readout {
    uint64_t leds;
    uint64_t timestamp;
    struct search search; /* spikes mode */
    uint8_t flags;
};

static struct plan plans[3];
static struct plan *volatile plan = &plans[0]; /* runs, or ran last */
static struct plan *volatile next_plan;        /* begins with the next exposure after a flush */
static uint32_t good_sh = BOOT_SH, good_icg = BOOT_ICG; /* the last good ones */

/* changed by TIM5's interrupt, or with interrupts off */
static enum phase phase;
static uint32_t edges;     /* of this phase */
static uint32_t remaining; /* read-outs to begin, if they are counted */
static uint32_t begun, done;
static uint32_t table_index;
static struct readout exposed;     /* the one the sensor gathers light for */
static struct readout readouts[2]; /* begun; one may begin before the last one is done */
static uint64_t edge_time;         /* of the last ICG edge, master clocks since boot */
static uint32_t stop_tick;         /* SysTick when the timers stopped */
static uint32_t icg_period, sh_period; /* of the timers */

/* changed by the ADC's interrupt, or with interrupts off */
static bool seamless;
static struct frame *filling, *next_frame;
static bool refusal_due;

/* --- clocks ------------------------------------------------------------------------------------ */

static void clocks_init(void)
{
    TIM3->ARR = CYCLES_PER_CLOCK - 1u;
    TIM3->CCMR2 = TIM_CCMR2_OC3M_PWM2; /* low, then high: the sensor sees its ICG edges at high fM */
    TIM3->CCR3 = CYCLES_PER_CLOCK / 2u;
    TIM3->CCER = TIM_CCER_CC3E;
    TIM3->CR1 = TIM_CR1_CEN;

    TIM2->CCMR1 = TIM_CCMR1_OC2M_PWM2 | TIM_CCMR1_OC1M_PWM2; /* SH: low at the pulse */
    TIM2->CCR1 = ADC_START;
    TIM2->CR2 = TIM_CR2_MMS_OC1REF;
    TIM2->SMCR = TIM_SMCR_TS_ITR2;
    TIM2->SMCR = TIM_SMCR_TS_ITR2 | TIM_SMCR_SMS_TRIGGER;
    TIM2->CCER = TIM_CCER_CC2E;

    TIM5->CCMR1 = TIM_CCMR1_OC1M_PWM1; /* ICG: high at the pulse; OC2, frozen, only interrupts */
    TIM5->CCR3 = RESYNCED;
    TIM5->SMCR = TIM_SMCR_TS_ITR1;
    TIM5->SMCR = TIM_SMCR_TS_ITR1 | TIM_SMCR_SMS_TRIGGER;
    TIM5->CCER = TIM_CCER_CC1E;
}

static void clocks_halt(void)
{
    TIM2->CR1 = TIM_CR1_URS;
    TIM5->CR1 = TIM_CR1_URS;
    stop_tick = SYSTICK->VAL;
    /* its interrupt may not have come any more; no branch, for two that should take equally long */
    edge_time += (TIM5->SR & TIM_SR_UIF) * icg_period + TIM5->CNT;
}

/* Between pulses, and so that SH's edges keep their distance over the start that follows. */
static void clocks_stop(void)
{
    if (!(TIM5->CR1 & TIM_CR1_CEN))
        return;
    const uint32_t sh_first = sh_period < SH_MIN ? SH_PULSE : SH_MIN - SH_DELAY;
    uint32_t icg, sh;
    do {
        icg = TIM5->CNT;
        sh = TIM2->CNT;
    } while (icg < ICG_PULSE || icg >= icg_period - 1u || sh < sh_first || sh >= sh_period - 1u);
    clocks_halt();
}

static void timer_prepare(struct tim *timer, uint32_t period, uint32_t delay)
{
    timer->CR1 = TIM_CR1_URS;
    timer->PSC = CYCLES_PER_CLOCK - 1u;
    timer->ARR = period - 1u;
    timer->EGR = TIM_EGR_UG; /* also begins the prescaler's count anew */
    timer->CNT = period - delay;
}

/* Without pulses, they only keep the time. */
static void clocks_start(uint32_t icg, uint32_t sh, bool pulses)
{
    icg_period = icg;
    sh_period = sh;
    /* no pulse while the counters pass through 0 */
    TIM5->CCR1 = 0;
    TIM2->CCR2 = 0;
    timer_prepare(TIM5, icg, ICG_DELAY);
    timer_prepare(TIM2, sh, SH_DELAY);
    TIM5->CCR1 = pulses ? ICG_PULSE : 0;
    TIM2->CCR2 = pulses ? SH_PULSE : 0;
    TIM5->DIER = TIM_DIER_UIE;
    TIM2->DIER = 0;
    TIM5->SR = 0;
    TIM2->SR = 0;

    TIM3->CR2 = TIM_CR2_MMS_UPDATE;
    while (!(TIM5->CR1 & TIM_CR1_CEN)) {
    }
    const uint32_t now = SYSTICK->VAL;
    TIM3->CR2 = TIM_CR2_MMS_RESET;
    /* SysTick counts down, and is far from having come around */
    const uint32_t rest = stop_tick >= now ? stop_tick - now : stop_tick + TICK_CYCLES - now;
    edge_time += rest / CYCLES_PER_CLOCK + ICG_DELAY;
    edge_time -= icg; /* as if it were the last edge */
}

/* --- ADC --------------------------------------------------------------------------------------- */

static void adc_init(void)
{
    TIM4->ARR = ELEMENT_CYCLES - 1u;
    TIM4->CCMR2 = TIM_CCMR2_OC4M_PWM2;
    TIM4->CCR4 = ADC_TRIGGER;
    TIM4->CCER = TIM_CCER_CC4E;
    TIM4->SMCR = TIM4_FROM_TIM2;
    ADC_COMMON->CCR = ADC_CCR_ADCPRE_DIV4; /* 21 MHz, 36 at most */
    ADC1->SMPR1 = 0;                       /* 3 cycles */
    ADC1->SQR3 = OS_CHANNEL;
    ADC_STREAM->PAR = dma_address(&ADC1->DR);
}

static void adc_stop(void)
{
    TIM4->SMCR = TIM4_FROM_TIM2;
    TIM4->CR1 = 0;
    ADC1->CR2 = 0; /* off: a conversion too many ends here */
    ADC_STREAM->CR = 0;
    while (ADC_STREAM->CR & DMA_CR_EN) {
    }
    DMA2->LIFCR = DMA_ISR_ALL;
}

/* Ready for the trigger. */
static void adc_prepare(void)
{
    uint32_t dma = DMA_CR_PL_HIGHEST | DMA_CR_MSIZE_16 | DMA_CR_PSIZE_16 | DMA_CR_MINC | DMA_CR_TCIE;
    uint32_t adc = ADC_CR2_EXTEN_RISING | ADC_CR2_EXTSEL_TIM4_CC4 | ADC_CR2_DMA | ADC_CR2_ADON;
    TIM4->CNT = 0;
    ADC_STREAM->M0AR = dma_address(filling->elements);
    ADC_STREAM->NDTR = ELEMENTS;
    if (seamless) {
        ADC_STREAM->M1AR = dma_address(next_frame->elements);
        ADC_STREAM->NDTR = good_icg / CLOCKS_PER_ELEMENT;
        dma |= DMA_CR_DBM;
        adc |= ADC_CR2_DDS;
    }
    ADC_STREAM->CR = dma | DMA_CR_EN;
    ADC1->SR = 0;
    ADC1->CR2 = adc;
}

/* A conversion was not fetched in time: the ADC asks DMA for no more, and the read-out is lost. */
static void adc_recover(void)
{
    adc_stop();
    done = begun;
    adc_prepare();
}

/* TIM5's interrupt, before ADC_START. */
static void adc_arm(void)
{
    if (!(TIM4->CR1 & TIM_CR1_CEN))
        TIM4->SMCR = TIM4_FROM_TIM2 | TIM_SMCR_SMS_TRIGGER;
    else if (icg_period % CLOCKS_PER_ELEMENT) {
        /* it runs on, but a fraction of an element off */
        TIM4->SMCR = TIM4_FROM_TIM2 | TIM_SMCR_SMS_RESET;
        TIM5->SR = ~TIM_SR_CC3IF;
        TIM5->DIER |= TIM_DIER_CC3IE;
    }
}

void sensor_queue_frame(void)
{
    const uint32_t masked = irq_save();
    if (seamless && !next_frame && (ADC_STREAM->CR & DMA_CR_EN)) {
        next_frame = frame_take();
        if (ADC_STREAM->CR & DMA_CR_CT)
            ADC_STREAM->M0AR = dma_address(next_frame->elements);
        else
            ADC_STREAM->M1AR = dma_address(next_frame->elements);
    }
    irq_restore(masked);
}

static void deliver(struct frame *frame, const struct readout *readout, uint32_t sequence)
{
    if (plan->mode == MODE_ORIGINAL) {
        link_frame(frame);
        sensor_queue_frame();
        return;
    }
    const bool spikes = plan->mode == MODE_SPIKES;
    uint8_t flags = readout->flags;
    if (refusal_due)
        flags |= FLAG_REFUSED;
    refusal_due = false;
    frame->header = (struct header){
        .magic = STREAM_MAGIC,
        .version = spikes ? SPIKES_VERSION : STREAM_VERSION,
        .flags = flags,
        .sequence = sequence,
        .leds = readout->leds,
        .timestamp = readout->timestamp,
        .icg_period = icg_period,
        .sh_period = sh_period,
    };
    frame->is_brief = spikes;
    if (!spikes) {
        frame_seal(frame);
        return;
    }
    frame->search = readout->search;
    frame_search(frame);
    sensor_queue_frame();
}

/* A read-out is complete. */
void DMA2_Stream0_IRQHandler(void)
{
    uint32_t masked = irq_save();
    if (!(DMA2->LISR & DMA_ISR_TCIF)) {
        irq_restore(masked);
        return;
    }
    DMA2->LIFCR = DMA_ISR_ALL;
    struct frame *frame = filling;
    const struct readout readout = readouts[done % 2u];
    const uint32_t sequence = done++;
    const bool last = phase == IDLE && done == begun;
    if (!seamless) {
        adc_stop();
        filling = frame_take();
        if (!last)
            adc_prepare();
    } else {
        filling = next_frame;
        next_frame = NULL;
        if (last)
            adc_stop();
    }
    irq_restore(masked);
    deliver(frame, &readout, sequence);
}

/* --- read-outs --------------------------------------------------------------------------------- */

/* What to look for in the next read-out, with these LEDs lit. */
static void plan_search(uint64_t leds)
{
    struct search *search = &exposed.search;
    const uint32_t first = plan->first_window[table_index];
    search->saturated = plan->saturated;
    search->threshold = plan->threshold;
    search->count = (uint8_t)(plan->first_window[table_index + 1u] - first);
    for (uint32_t n = 0; n < search->count; n++)
        search->windows[n] = plan->windows[first + n];
    const bool dark = !leds;
    for (uint32_t n = 0; n < search->count; n++)
        leds &= leds - 1u;
    search->alone = !dark && !leds; /* as many windows as LEDs: one is in each */
}

/* An exposure begins, which the next ICG edge reads out. */
static void expose(void)
{
    exposed.flags = 0;
    if (next_plan) {
        plan = next_plan;
        next_plan = NULL;
        remaining = plan->count;
        table_index = 0;
        exposed.flags = FLAG_CHANGED;
    }
    if (plan->mode != MODE_ORIGINAL) {
        exposed.leds = lights_plan(plan, table_index);
        if (plan->mode == MODE_SPIKES)
            plan_search(exposed.leds);
        table_index = table_index + 1u < plan->frames ? table_index + 1u : 0;
    } else if (remaining <= 2u) {
        exposed.leds = 1u << (remaining == 1u ? LED_LAST : LED_SECOND_TO_LAST);
        TIM2->DIER = TIM_DIER_UIE; /* its flag is still set by the SH edge that came with ICG's */
    }
}

static void read_out(void)
{
    exposed.timestamp = edge_time + SH_EDGE;
    readouts[begun++ % 2u] = exposed;
    if (plan->count && --remaining == 0 && !next_plan)
        phase = IDLE;
    else
        expose();
}

/* The flush is over. */
static void begin(void)
{
    clocks_stop();
    phase = LEAD;
    edges = 0;
    clocks_start(next_plan->icg_period, next_plan->sh_period, true);
}

static void icg_edge(void)
{
    if (phase == READ) {
        if (ADC1->SR & ADC_SR_OVR)
            adc_recover();
        adc_arm(); /* the one thing that cannot wait */
        if (plan->mode != MODE_ORIGINAL && exposed.leds)
            while (TIM5->CNT < SH_EDGE - 2u) { /* what it takes comes on top; later, it would light the next frame */
            }
    }
    lights_off();
    lights_none();
    TIM2->DIER = 0;
    edge_time += icg_period;
    HEARTBEAT_PORT->ODR ^= 1u << HEARTBEAT_PIN;
    switch (phase) {
    case FLUSH:
        if (++edges == FLUSH_PULSES)
            begin();
        break;
    case LEAD:
        if (++edges == LEAD_EDGES) {
            phase = READ;
            expose();
        }
        break;
    case READ:
        read_out();
        break;
    case AWAIT:
    case IDLE:
        break;
    }
}

void TIM5_IRQHandler(void)
{
    const uint32_t flags = TIM5->SR & TIM5->DIER;
    TIM5->SR = ~flags;
    if (flags & TIM_SR_UIF)
        icg_edge();
    if (flags & TIM_SR_CC3IF) {
        TIM4->SMCR = TIM4_FROM_TIM2;
        TIM5->DIER &= ~TIM_DIER_CC3IE;
    }
    if (flags & TIM_SR_CC2IF)
        lights_step();
}

/* Original mode's LEDs. How many SH edges there were since ICG's is told by the clock, not by
 * counting interrupts: at the shortest periods some may come too late. */
void TIM2_IRQHandler(void)
{
    const uint32_t masked = irq_save(); /* or ICG's interrupt comes before the LED is lit */
    TIM2->SR = 0;
    if (TIM2->DIER & TIM_DIER_UIE) {
        const uint32_t clocks = TIM5->CNT;
        const uint32_t edge = clocks / sh_period + (clocks % sh_period != 0);
        if (edge + LIT_SH_PULSES >= icg_period / sh_period) {
            lights_on(exposed.leds);
            TIM2->DIER = 0;
        }
    }
    irq_restore(masked);
}

struct plan *sensor_spare_plan(void)
{
    uint32_t n = 0;
    const uint32_t masked = irq_save();
    while (&plans[n] == plan || &plans[n] == next_plan)
        n++;
    irq_restore(masked);
    return &plans[n];
}

static void flush(void)
{
    phase = FLUSH;
    edges = 0;
    clocks_start(FLUSH_ICG, FLUSH_SH, true);
}

/* Until a rising edge on the sync line: no pulses, so that the clocks can be stopped at any time. */
static void await_sync(void)
{
    phase = AWAIT;
    clocks_start(FLUSH_ICG, FLUSH_SH, false);
    EXTI->PR = SYNC_LINE;
    EXTI->IMR |= SYNC_LINE;
}

/* From the edge to the timers' start there is nothing that takes longer one time than another, but
 * for an interrupt of the same priority. The timers start with fM, whose phase differs from board to
 * board: up to a clock. To stay together, real boards also need one clock: HSI differs by 1 %, which
 * is 37 us in a read-out. */
void EXTI1_IRQHandler(void)
{
    if (!(EXTI->PR & SYNC_LINE))
        return; /* an edge of before, when nobody waited any more */
    EXTI->PR = SYNC_LINE;
    EXTI->IMR &= ~SYNC_LINE;
    if (phase == AWAIT) {
        clocks_halt();
        flush();
    }
}

static void give_up(void)
{
    EXTI->IMR &= ~SYNC_LINE;
    adc_stop();
    lights_off();
    lights_none();
    TIM2->DIER = 0;
    next_plan = NULL;
    refusal_due = false;
    begun = done = 0;
    link_abandon();
}

void sensor_acquire(struct plan *new_plan)
{
    const uint32_t masked = irq_save();
    give_up();
    good_sh = new_plan->sh_period;
    good_icg = new_plan->icg_period;
    seamless = good_icg <= SEAMLESS_MAX;
    if (!filling)
        filling = frame_take();
    if (seamless && !next_frame)
        next_frame = frame_take();
    if (!seamless && next_frame) {
        frame_release(next_frame);
        next_frame = NULL;
    }
    adc_prepare();
    next_plan = new_plan;
    if (phase != FLUSH || new_plan->await_sync) { /* else it goes on, for the newest plan */
        clocks_stop();
        if (new_plan->await_sync)
            await_sync();
        else
            flush();
    }
    irq_restore(masked);
}

bool sensor_exchange(struct plan *new_plan)
{
    const uint32_t masked = irq_save();
    const struct plan *last = next_plan ? next_plan : plan;
    const bool possible = last->mode == new_plan->mode && !new_plan->await_sync &&
                          (phase == LEAD || phase == READ) &&
                          new_plan->sh_period == sh_period && new_plan->icg_period == icg_period;
    if (possible)
        next_plan = new_plan;
    irq_restore(masked);
    return possible;
}

void sensor_halt(void)
{
    const uint32_t masked = irq_save();
    give_up();
    if (phase == FLUSH || phase == AWAIT) {
        clocks_stop();
        clocks_start(good_icg, good_sh, true);
    }
    phase = IDLE;
    irq_restore(masked);
}

uint32_t sensor_mode(void)
{
    const uint32_t masked = irq_save();
    const struct plan *last = next_plan ? next_plan : plan;
    const uint32_t mode = phase == IDLE ? MODE_ORIGINAL : last->mode;
    irq_restore(masked);
    return mode;
}

bool sensor_awaits(void)
{
    return phase == AWAIT;
}

void sensor_mark_refusal(void)
{
    refusal_due = true;
}

void sensor_periods(uint32_t *sh, uint32_t *icg)
{
    *sh = good_sh;
    *icg = good_icg;
}

void sensor_init(void)
{
    clocks_init();
    adc_init();
    stop_tick = TICK_CYCLES - 1u; /* time 0 is when SysTick started */
    clocks_start(good_icg, good_sh, true);
    SYSCFG->EXTICR1 = 1u << SYSCFG_EXTICR1_EXTI1; /* port B */
    EXTI->RTSR |= SYNC_LINE;
    irq_enable(IRQ_EXTI1, PRIORITY_ICG);
    irq_enable(IRQ_DMA2_STREAM0, PRIORITY_ADC);
    irq_enable(IRQ_TIM2, PRIORITY_SH);
    irq_enable(IRQ_TIM5, PRIORITY_ICG);
}
