/* The microcontroller, what its pins are wired to, and virtual time.
 *
 * Time is counted in ticks of 1/336 MHz: 4 a cycle at 84 MHz, 21 a cycle of the 16 MHz HSI. All
 * state is in struct machine; there are no globals. A CPU instruction runs at `now`; everything
 * else happens in events, each at its exact tick, always before an instruction that starts later.
 */
#ifndef TWIN_MACHINE_H
#define TWIN_MACHINE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include <unicorn/unicorn.h>

#define TICKS_PER_SECOND 336000000u
#define TICKS_PER_CYCLE 4u
#define NEVER UINT64_MAX

#define FLASH_BASE 0x08000000u
#define FLASH_SIZE 0x80000u
#define RAM_BASE 0x20000000u
#define RAM_SIZE 0x18000u
#define PERIPHERALS 0x40000000u
#define SYSTEM 0xE0000000u

#define EXCEPTIONS 128 /* 16 of the core, 85 of the F401, rest never enabled */
#define PORTS 8        /* A to H, of which F and G do not exist */
#define PINS (PORTS * 16)
#define NO_PIN 0xFFu
#define TIMERS 4 /* TIM2 to TIM5, by index 0 to 3 */
#define STREAMS 8
#define SOURCES 65 /* of light: the one always on, then LED channels 0 to 63 */
#define LEDS 64
#define PIXELS 3648
#define ELEMENTS 3694
#define READOUTS 64 /* the last ones are kept */

/* What may happen in the future. On the same tick, the lower number goes first. */
enum source {
    EVENT_TIM, /* four of them */
    EVENT_RCC = EVENT_TIM + TIMERS,
    EVENT_SPI3,
    EVENT_SPI2,
    EVENT_ADC,
    EVENT_DMA,
    EVENT_SYSTICK,
    EVENTS
};

/* What a pin is wired to. */
enum role {
    ROLE_NONE,
    ROLE_FM,
    ROLE_SH,
    ROLE_ICG,
    ROLE_OS,
    ROLE_CLOCK, /* a clock output nobody listens to */
    ROLE_SCK,
    ROLE_MISO,
    ROLE_MOSI,
    ROLE_CHAIN_CLOCK,
    ROLE_CHAIN_DATA,
    ROLE_CHAIN_LATCH,
    ROLE_CHAIN_ENABLE,
    ROLE_LED /* ROLE_LED + channel */
};

/* The functions of libunicorn that are used; found by the caller. */
struct unicorn {
    __typeof__(uc_open) *open;
    __typeof__(uc_close) *close;
    __typeof__(uc_ctl) *ctl;
    __typeof__(uc_mem_map_ptr) *mem_map_ptr;
    __typeof__(uc_mmio_map) *mmio_map;
    __typeof__(uc_hook_add) *hook_add;
    __typeof__(uc_reg_read) *reg_read;
    __typeof__(uc_reg_write) *reg_write;
    __typeof__(uc_emu_start) *emu_start;
    __typeof__(uc_emu_stop) *emu_stop;
    __typeof__(uc_strerror) *strerror;
};

/* Pixels' charge (electrons, mean) and ticks of their transfer in; 3694 codes and the idle one out.
 * A callback returns 0, or nonzero when it failed. */
typedef int (*digitise_fn)(const double *charge, uint64_t time, uint16_t *codes);
/* Called when light matters and the world moves, with the LEDs that are lit from then on, by bit: only
 * their rates count until the next call. Returns 1 if it changed the rates, -1 on failure. */
typedef int (*light_fn)(uint64_t time, uint64_t lit);

struct config {
    struct unicorn unicorn;
    uint8_t role[PINS];
    uint8_t chain_first;     /* channel of the first 74HC595's QA */
    uint8_t inverted;        /* a 74HC04 between fM, SH, ICG and the sensor */
    uint8_t record;          /* keep edges */
    uint8_t record_clocks;   /* of fM and other clocks too */
    uint8_t singly;          /* no bursts: for tests */
    uint16_t idle_code;      /* before the first read-out */
    double *rates;           /* [SOURCES][PIXELS], electrons per second */
    double transfer_fraction;
    double full_well;        /* electrons */
    digitise_fn digitise;
    light_fn light;          /* NULL: nothing moves */
};

/* --- the log -------------------------------------------------------------------------------- */
struct edge {
    uint64_t time; /* ticks */
    uint16_t what; /* pin, or one of these */
    uint8_t level;
    uint8_t pad[5];
};
#define EDGE_LINK 0x100u    /* the link's clock runs */
#define EDGE_SAMPLING 0x101u /* the ADC's sampling switch is closed */

struct exception_entry {
    uint64_t time;
    uint16_t number;
    uint8_t kind; /* 0 entry, 1 tail-chained entry, 2 return */
    uint8_t pad[5];
};

struct violation {
    uint64_t time;
    double value; /* seconds, or hertz for fM */
    uint32_t kind; /* bit number of PROBLEM_... */
    uint32_t pad;
};

struct log {
    void *items;
    size_t size; /* of an item */
    size_t count;
    size_t room;
};

/* --- parts ---------------------------------------------------------------------------------- */
struct nvic {
    uint64_t pending[2], enabled[2], active[2], line[2];
    uint8_t priority[EXCEPTIONS];
    bool changed; /* an exception may have to be taken */
    uint32_t vtor, scr, ccr, shcsr, cpacr, prigroup, fpccr;
    uint32_t systick_ctrl, systick_load;
    uint64_t systick_base; /* ticks at which it was last reloaded */
    uint32_t systick_value; /* when stopped */
    bool systick_flag;
    uint32_t demcr, dwt_ctrl;
    uint32_t cycles_offset;
};

struct cpu {
    uint32_t pc;        /* of the instruction that runs */
    uint32_t next;      /* the one after it, unless it branches */
    uint32_t cost;      /* its cycles, not yet counted */
    uint32_t it_first, it_end; /* the IT block it is in */
    bool sleep_on_exit;
    bool started;
    uint16_t *decoded;  /* flash, by halfword: 0 not yet, else cost | kind */
};

struct rcc {
    uint32_t cr, pllcfgr, cfgr, cir, csr, dckcfgr;
    uint32_t rstr[5], enr[5], lpenr[5]; /* AHB1, AHB2, -, APB1, APB2: offset / 4 */
    uint64_t pll_ready;
    uint32_t flash_acr, pwr_cr;
    uint32_t cpu, apb1, apb2, timers; /* ticks a clock */
    uint64_t grid; /* a tick at which the CPU clock rose */
};

struct pin {
    uint8_t level;
    uint8_t driven;   /* 0: by nothing outside; 2 + level otherwise */
    uint8_t timer, channel; /* of the alternate function, or timer = NO_PIN */
    uint8_t mode;
    bool link; /* carries a signal of SPI2 or SPI3 */
};

struct gpio {
    uint32_t moder, otyper, ospeedr, pupdr, odr, afr[2];
};

struct exti {
    uint32_t imr, emr, rtsr, ftsr, pr, exticr[4];
};

struct tim {
    uint32_t cr1, cr2, smcr, dier, sr, ccmr[2], ccer, psc, arr, ccr[4];
    uint32_t psc_now, arr_now, ccr_now[4]; /* those in force */
    uint64_t base;        /* running: tick at which the counter was base_count, prescaler 0 */
    uint32_t base_count;
    uint64_t phase;       /* stopped: ticks the prescaler has gone */
    uint64_t done;        /* everything up to here has happened */
    uint32_t events;      /* what must happen on time: bit 0 update, bits 1 to 4 compare */
    uint8_t ref[4];       /* OCxREF */
    uint8_t pins[4][2];
    uint32_t version;     /* of what shapes its outputs */
    uint64_t paced;       /* nothing matters but that it starts the ADC every so many ticks */
};

struct adc {
    uint32_t sr, cr1, cr2, smpr[2], sqr[3], dr, ccr;
    bool busy;
    bool dma_done; /* no more requests until DMA is set again */
    uint64_t on, hold;
    uint64_t sampling, period; /* ticks from a start to the hold and to the end, of the last one */
};

struct stream {
    uint32_t cr, ndtr, par, m0ar, m1ar, fcr;
    uint32_t reload, index;
    uint32_t ahead; /* memory to peripheral: the datum read in advance */
    bool has_ahead;
    uint8_t port; /* what is at par */
};

struct dma {
    struct stream stream[STREAMS];
    uint32_t isr[2];
};

struct spi {
    uint32_t cr1, cr2, sr;
    uint8_t tx, rx, shift, received;
    bool tx_full, ovr_read;
    uint32_t bits; /* done of the byte that is being shifted */
    uint64_t byte_end;
};

/* The host that masters the link. */
struct host {
    const uint8_t *tx;
    uint8_t *rx;
    uint64_t bits, next_bit, start, hertz;
    uint64_t chunk_start, chunk_bits; /* being shifted */
    uint64_t record_end;
    uint64_t underruns;
    uint8_t sck_pin, miso_pin;
};

struct crc {
    uint32_t dr, idr;
};

enum problem {
    PROBLEM_FM = 1,          /* no master clock, or out of range */
    PROBLEM_T1 = 2,
    PROBLEM_T2 = 4,
    PROBLEM_T3 = 8,
    PROBLEM_T4 = 16,
    PROBLEM_SH_ICG = 32,     /* SH period does not divide ICG period, or no SH pulse within ICG */
    PROBLEM_INTEGRATION = 64,
    PROBLEM_CUT = 128,       /* read-out ended by the next ICG */
    PROBLEM_FM_CHANGED = 256 /* master clock changed within a read-out */
};

struct readout {
    uint64_t transfer;    /* SH's falling edge */
    uint64_t start;       /* ICG's rising edge */
    uint64_t integration; /* ticks */
    uint64_t lit[SOURCES]; /* ticks, within the integration */
    uint32_t problems;
    uint32_t sampled;
};

struct ccd {
    bool sh, icg; /* levels at the sensor */
    uint64_t sh_rise, sh_fall, icg_fall, icg_rise;
    bool pulse_in_icg; /* the SH pulse in progress began within ICG's */
    uint32_t pulses;   /* within ICG's pulse */
    uint32_t problems; /* of the read-out to come */
    uint64_t integration;
    /* charge of pixel j: residue_scale * residue[j] + sum over k of weight[k] * rates[k][j] */
    double weight[SOURCES];
    double residue_scale, residue_max;
    double residue[PIXELS];
    uint64_t lit;      /* LEDs, by bit */
    uint64_t weighted; /* LEDs with weight or light since the last SH */
    uint64_t since[SOURCES], on[SOURCES], counted[SOURCES];
    double row_max[SOURCES];
    uint64_t row_known[2];
    /* the shift register's, in the same form */
    double out_weight[SOURCES], out_scale;
    double out_residue[PIXELS];
    bool out_has_residue;
    uint64_t out_lit[SOURCES];
    uint64_t out_time, out_integration;
    /* the read-out */
    bool reading, digitised;
    uint64_t element; /* ticks */
    uint64_t end;
    uint32_t fm_version;
    uint8_t fm_pin;
    uint16_t codes[ELEMENTS + 1];
    struct readout readouts[READOUTS];
    uint64_t readout_count;
};

struct chain {
    uint64_t shifted, latched;
    bool enabled;
};

struct machine {
    struct config config;
    uc_engine *uc;
    uint8_t *flash, *ram;
    uint64_t now, next, deadline;
    uint64_t at[EVENTS];
    uint8_t watch_pin, watch_level; /* stop when so */
    bool stop, failed, timing_failed, callback_failed;
    char message[512], name[40];

    struct cpu cpu;
    struct nvic nvic;
    struct rcc rcc;
    struct pin pin[PINS];
    struct gpio gpio[PORTS];
    struct exti exti;
    struct tim tim[TIMERS];
    struct adc adc;
    struct dma dma[2];
    struct spi spi[2]; /* SPI2, SPI3 */
    struct host host;
    struct crc crc;
    struct ccd ccd;
    struct chain chain;

    struct log edges, exceptions, violations;
};

/* machine.c */
void fail(struct machine *m, const char *format, ...) __attribute__((format(printf, 2, 3)));
void machine_schedule(struct machine *m, unsigned event, uint64_t time);
void machine_events(struct machine *m, uint64_t until);
bool machine_event(struct machine *m, uint64_t until);
void log_add(struct machine *m, struct log *log, const void *item);
void record(struct machine *m, uint64_t time, unsigned what, bool level);

/* bus.c */
uint32_t bus_read(struct machine *m, uint32_t address, unsigned size);
void bus_write(struct machine *m, uint32_t address, unsigned size, uint32_t value);
const char *register_name(struct machine *m, uint32_t address);
uint64_t bus_mmio_read(uc_engine *uc, uint64_t offset, unsigned size, void *user);
void bus_mmio_write(uc_engine *uc, uint64_t offset, unsigned size, uint64_t value, void *user);
uint64_t bus_system_read(uc_engine *uc, uint64_t offset, unsigned size, void *user);
void bus_system_write(uc_engine *uc, uint64_t offset, unsigned size, uint64_t value, void *user);
/* true if all of `value` is within `allowed`; complains otherwise */
bool allowed_bits(struct machine *m, uint32_t address, uint32_t value, uint32_t allowed);

/* cpu.c */
bool cpu_open(struct machine *m);
void cpu_reset(struct machine *m);
void cpu_run(struct machine *m);
uint32_t cpu_exception(struct machine *m); /* IPSR */
/* The group priority that BASEPRI or FAULTMASK ask for, 256 if none. */
int cpu_masked_priority(struct machine *m);

/* nvic.c */
void nvic_reset(struct machine *m);
void irq_line_changed(struct machine *m, unsigned irq, bool level);
/* A peripheral's interrupt line has this level: it becomes pending when it rises, and again if it
 * is still up when its handler returns. */
static inline void irq_line(struct machine *m, unsigned irq, bool level) {
    unsigned number = 16 + irq;
    if (((m->nvic.line[number / 64] >> (number % 64)) & 1) != level)
        irq_line_changed(m, irq, level);
}
void nvic_pend(struct machine *m, unsigned number);
int nvic_best(const struct machine *m);
int nvic_group_priority(const struct machine *m, int number);
int nvic_active_priority(const struct machine *m);
void nvic_activate(struct machine *m, int number);
void nvic_deactivate(struct machine *m, int number);
uint32_t nvic_read(struct machine *m, uint32_t address);
void nvic_write(struct machine *m, uint32_t address, unsigned size, uint32_t value);
void systick_event(struct machine *m, uint64_t time);
uint32_t cycle_counter(const struct machine *m);

/* rcc.c */
void rcc_reset(struct machine *m);
uint32_t rcc_read(struct machine *m, uint32_t offset);
void rcc_write(struct machine *m, uint32_t offset, uint32_t value);
void rcc_event(struct machine *m, uint64_t time);
bool rcc_clocked(const struct machine *m, uint32_t address);
bool rcc_held(const struct machine *m, uint32_t address);

/* gpio.c */
void gpio_reset(struct machine *m, unsigned port, uint64_t time);
uint32_t gpio_read(struct machine *m, unsigned port, uint32_t offset);
void gpio_write(struct machine *m, unsigned port, uint32_t offset, uint32_t value);
void gpio_drive(struct machine *m, unsigned pin, uint8_t driven, uint64_t time);
void pin_set(struct machine *m, unsigned pin, bool level, uint64_t time);
bool pin_observed(const struct machine *m, unsigned pin);
void exti_edge(struct machine *m, unsigned pin, bool rising, bool falling);
void exti_reset(struct machine *m);
void syscfg_reset(struct machine *m);
uint32_t exti_read(struct machine *m, uint32_t offset);
void exti_write(struct machine *m, uint32_t offset, uint32_t value);

/* tim.c */
void tim_reset(struct machine *m, unsigned n);
uint32_t tim_read(struct machine *m, unsigned n, uint32_t offset);
void tim_write(struct machine *m, unsigned n, uint32_t offset, uint32_t value);
void tim_event(struct machine *m, unsigned n, uint64_t time);
void tim_replan(struct machine *m);
bool tim_output(struct machine *m, unsigned n, unsigned channel, uint64_t time);
/* ticks of a period of a PWM output, 0 if there is none */
uint64_t tim_period(const struct machine *m, unsigned n, unsigned channel);
bool tim_running(const struct machine *m);

/* adc.c */
void adc_reset(struct machine *m);
uint32_t adc_read(struct machine *m, uint32_t offset);
void adc_write(struct machine *m, uint32_t offset, uint32_t value);
void adc_event(struct machine *m, uint64_t time);
/* EXTSEL that the ADC listens to on a rising edge, -1 if to none */
int adc_listens(const struct machine *m);
void adc_trigger(struct machine *m, uint64_t time);
bool adc_requests(const struct machine *m);

/* dma.c */
void dma_reset(struct machine *m, unsigned n);
uint32_t dma_read(struct machine *m, unsigned n, uint32_t offset);
void dma_write(struct machine *m, unsigned n, uint32_t offset, uint32_t value);
void dma_event(struct machine *m, uint64_t time);
/* a peripheral's request line is up: serve it if a stream is set to */
void dma_request(struct machine *m, unsigned n, unsigned stream, unsigned channel);

/* spi.c */
void spi_reset(struct machine *m, unsigned n);
uint32_t spi_read(struct machine *m, unsigned n, uint32_t offset);
void spi_write(struct machine *m, unsigned n, uint32_t offset, uint32_t value);
void spi_requests(struct machine *m, unsigned n);
bool spi_requests_tx(const struct machine *m, unsigned n);
bool spi_requests_rx(const struct machine *m, unsigned n);
void spi_slave_event(struct machine *m, uint64_t time);
void spi_master_event(struct machine *m, uint64_t time);
void host_start(struct machine *m);
uint64_t host_time(const struct machine *m, uint64_t bit);
void chain_pin(struct machine *m, unsigned role, bool level, uint64_t time);

/* burst.c */
bool burst(struct machine *m, uint64_t until);

/* crc.c */
void crc_reset(struct machine *m);
uint32_t crc_read(struct machine *m, uint32_t offset);
void crc_write(struct machine *m, uint32_t offset, uint32_t value);

/* ccd.c */
void ccd_reset(struct machine *m);
void ccd_sh(struct machine *m, bool level, uint64_t time);
void ccd_icg(struct machine *m, bool level, uint64_t time);
void ccd_light(struct machine *m, unsigned channel, bool on, uint64_t time);
uint16_t ccd_sample(struct machine *m, uint64_t time);
void ccd_rates_changed(struct machine *m);
void ccd_charge(struct machine *m, double *charge, uint64_t time);

#endif
