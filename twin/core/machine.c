/* Life cycle, the event loop, the log, and the interface that Python calls. */
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "machine.h"

#define BURST_TICKS 1000u /* less is not worth it */
#define EXPORT __attribute__((visibility("default")))

/* The first complaint counts; it stops the machine for good. */
void fail(struct machine *m, const char *format, ...) {
    if (m->failed) return;
    va_list arguments;
    va_start(arguments, format);
    int length = vsnprintf(m->message, sizeof m->message, format, arguments);
    va_end(arguments);
    if (length > 0 && (size_t)length < sizeof m->message)
        (void)snprintf(m->message + length, sizeof m->message - (size_t)length,
                       " (PC 0x%08X, %.9f s)", m->cpu.pc, (double)m->now / TICKS_PER_SECOND);
    m->failed = true;
}

void log_add(struct machine *m, struct log *log, const void *item) {
    if (!log->size) return;
    if (log->count == log->room) {
        size_t room = log->room ? 2 * log->room : 256;
        void *items = realloc(log->items, room * log->size);
        if (!items) {
            fail(m, "out of memory for the log");
            return;
        }
        log->items = items;
        log->room = room;
    }
    memcpy((uint8_t *)log->items + log->count++ * log->size, item, log->size);
}

void record(struct machine *m, uint64_t time, unsigned what, bool level) {
    struct edge e = {.time = time, .what = (uint16_t)what, .level = level};
    log_add(m, &m->edges, &e);
}

/* --- events --------------------------------------------------------------------------------- */
void machine_schedule(struct machine *m, unsigned event, uint64_t time) {
    m->at[event] = time;
    if (time < m->next) m->next = time;
}

/* Let the next event happen if it is not later than `until`. */
bool machine_event(struct machine *m, uint64_t until) {
    unsigned first = 0;
    uint64_t time = m->at[0];
    for (unsigned i = 1; i < EVENTS; i++)
        if (m->at[i] < time) {
            time = m->at[i];
            first = i;
        }
    m->next = time;
    if (time == NEVER || time > until) return false;
    if ((first == EVENT_SPI2 || (first < EVENT_RCC && m->tim[first].paced)) &&
        until - time > BURST_TICKS && !m->config.singly && burst(m, until))
        return true;
    m->at[first] = NEVER;
    if (time > m->now) m->now = time;
    if (first < EVENT_RCC) {
        tim_event(m, first, time);
        return true;
    }
    switch (first) {
    case EVENT_RCC: rcc_event(m, time); break;
    case EVENT_SPI3: spi_master_event(m, time); break;
    case EVENT_SPI2: spi_slave_event(m, time); break;
    case EVENT_ADC: adc_event(m, time); break;
    case EVENT_DMA: dma_event(m, time); break;
    default: systick_event(m, time);
    }
    return true;
}

void machine_events(struct machine *m, uint64_t until) {
    while (machine_event(m, until)) {
    }
}

/* --- life cycle ----------------------------------------------------------------------------- */
static void reset_peripherals(struct machine *m) {
    for (unsigned i = 0; i < EVENTS; i++) m->at[i] = NEVER;
    m->next = NEVER;
    for (unsigned i = 0; i < TIMERS; i++) tim_reset(m, i);
    nvic_reset(m);
    exti_reset(m);
    syscfg_reset(m);
    for (unsigned i = 0; i < PORTS; i++) gpio_reset(m, i, m->now);
    adc_reset(m);
    dma_reset(m, 0);
    dma_reset(m, 1);
    spi_reset(m, 0);
    spi_reset(m, 1);
    crc_reset(m);
    rcc_reset(m);
}

EXPORT void twin_free(struct machine *m) {
    if (!m) return;
    if (m->uc) (void)m->config.unicorn.close(m->uc);
    free(m->flash);
    free(m->ram);
    free(m->cpu.decoded);
    free(m->edges.items);
    free(m->exceptions.items);
    free(m->violations.items);
    free(m);
}

EXPORT struct machine *twin_new(const struct config *config) {
    struct machine *m = calloc(1, sizeof *m);
    if (!m) return NULL;
    m->config = *config;
    m->flash = aligned_alloc(4096, FLASH_SIZE);
    m->ram = aligned_alloc(4096, RAM_SIZE);
    m->cpu.decoded = calloc(FLASH_SIZE / 2, sizeof *m->cpu.decoded);
    m->violations.size = sizeof(struct violation);
    m->watch_pin = NO_PIN;
    if (!m->flash || !m->ram || !m->cpu.decoded) {
        fail(m, "out of memory");
        return m;
    }
    memset(m->flash, 0xFF, FLASH_SIZE);
    memset(m->ram, 0, RAM_SIZE);
    ccd_reset(m);
    reset_peripherals(m);
    if (config->record) m->edges.size = sizeof(struct edge);
    (void)cpu_open(m);
    return m;
}

EXPORT bool twin_load(struct machine *m, uint32_t address, const uint8_t *bytes, uint32_t size) {
    if (address < FLASH_BASE || address - FLASH_BASE > FLASH_SIZE ||
        size > FLASH_SIZE - (address - FLASH_BASE))
        return false;
    memcpy(m->flash + (address - FLASH_BASE), bytes, size);
    return true;
}

/* RAM keeps its content; the sensor and time go on. */
EXPORT void twin_reset(struct machine *m) {
    reset_peripherals(m);
    if (!m->failed) cpu_reset(m);
    m->cpu.started = true;
}

/* --- running -------------------------------------------------------------------------------- */
static void run(struct machine *m, uint64_t deadline) {
    if (m->failed || deadline <= m->now) return;
    m->deadline = deadline;
    if (!m->cpu.started) {
        m->cpu.started = true;
        cpu_reset(m);
    }
    if (!m->stop && !m->failed) cpu_run(m);
}

/* 0, or 1 if the machine has failed: twin_message says why. */
EXPORT int twin_run(struct machine *m, uint64_t ticks) {
    m->stop = false;
    run(m, m->now + ticks);
    return m->failed;
}

/* 0: time is out, 1: the pin has the level, -1: failed. */
EXPORT int twin_wait(struct machine *m, uint8_t pin, uint8_t level, uint64_t ticks) {
    if (m->failed) return -1;
    if (m->pin[pin].level == level) return 1;
    m->watch_pin = pin;
    m->watch_level = level;
    m->stop = false;
    run(m, m->now + ticks);
    m->watch_pin = NO_PIN;
    m->stop = false;
    if (m->failed) return -1;
    return m->pin[pin].level == level;
}

/* Clock bytes through the link; the firmware runs meanwhile. */
EXPORT int twin_transfer(struct machine *m, const uint8_t *tx, uint8_t *rx, uint64_t size,
                         uint64_t hertz) {
    memset(rx, 0, size);
    if (!size || m->failed) return m->failed;
    m->stop = false;
    m->host.tx = tx;
    m->host.rx = rx;
    m->host.bits = 8 * size;
    m->host.next_bit = 0;
    m->host.start = m->now;
    m->host.hertz = hertz;
    host_start(m);
    run(m, host_time(m, m->host.bits));
    machine_events(m, host_time(m, m->host.bits));
    m->host.tx = NULL;
    m->host.rx = NULL;
    return m->failed;
}

EXPORT void twin_drive(struct machine *m, uint8_t pin, int level) {
    gpio_drive(m, pin, level < 0 ? 0 : (uint8_t)(2 + (level != 0)), m->now);
}

/* --- looking -------------------------------------------------------------------------------- */
EXPORT uint64_t twin_time(const struct machine *m) { return m->now; }

EXPORT const char *twin_message(const struct machine *m) { return m->message; }

EXPORT int twin_failure(const struct machine *m) {
    return m->callback_failed ? 3 : m->timing_failed ? 2 : m->failed;
}

EXPORT int twin_pin(const struct machine *m, uint8_t pin) { return m->pin[pin].level; }

EXPORT bool twin_read(const struct machine *m, uint32_t address, uint8_t *bytes, uint32_t size) {
    const uint8_t *from = NULL;
    if (address - RAM_BASE <= RAM_SIZE && size <= RAM_SIZE - (address - RAM_BASE))
        from = m->ram + (address - RAM_BASE);
    if (address - FLASH_BASE <= FLASH_SIZE && size <= FLASH_SIZE - (address - FLASH_BASE))
        from = m->flash + (address - FLASH_BASE);
    if (!from) return false;
    memcpy(bytes, from, size);
    return true;
}

EXPORT uint32_t twin_register(struct machine *m, int number) {
    uint32_t value = 0;
    (void)m->config.unicorn.reg_read(m->uc, number, &value);
    return value;
}

EXPORT void twin_log_exceptions(struct machine *m) {
    m->exceptions.size = sizeof(struct exception_entry);
}

EXPORT const void *twin_log(struct machine *m, int which, uint64_t *count) {
    struct log *log = which == 0 ? &m->edges : which == 1 ? &m->exceptions : &m->violations;
    if (which == 0 && m->host.record_end && m->edges.size) {
        record(m, m->host.record_end, EDGE_LINK, false);
        m->host.record_end = 0;
    }
    *count = log->count;
    return log->items;
}

EXPORT void twin_log_clear(struct machine *m, int which) {
    struct log *log = which == 0 ? &m->edges : which == 1 ? &m->exceptions : &m->violations;
    log->count = 0;
}

EXPORT uint64_t twin_readouts(const struct machine *m, struct readout *out) {
    uint64_t count = m->ccd.readout_count < READOUTS ? m->ccd.readout_count : READOUTS;
    for (uint64_t i = 0; i < count; i++)
        out[i] = m->ccd.readouts[(m->ccd.readout_count - count + i) % READOUTS];
    return count;
}

EXPORT uint64_t twin_underruns(const struct machine *m) { return m->host.underruns; }

EXPORT void twin_rates_changed(struct machine *m) { ccd_rates_changed(m); }

/* Mean charge of every pixel now, electrons: for tests. */
EXPORT void twin_charge(struct machine *m, double *charge) { ccd_charge(m, charge, m->now); }

/* Drive the sensor alone, without a program: for tests. */
EXPORT void twin_pin_at(struct machine *m, uint64_t time, uint8_t pin, uint8_t level) {
    if (time > m->now) m->now = time;
    pin_set(m, pin, level != 0, m->now);
}

EXPORT uint64_t twin_sizes(int which) {
    switch (which) {
    case 0: return sizeof(struct config);
    case 1: return sizeof(struct edge);
    case 2: return sizeof(struct exception_entry);
    case 3: return sizeof(struct violation);
    default: return sizeof(struct readout);
    }
}
