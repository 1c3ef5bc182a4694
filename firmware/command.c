#include "command.h"

#define MODE_AT 10u

static uint32_t big_endian(const uint8_t *bytes)
{
    return ((uint32_t)bytes[0] << 24) | ((uint32_t)bytes[1] << 16) | ((uint32_t)bytes[2] << 8) |
           bytes[3];
}

static uint32_t little_endian(const uint8_t *bytes)
{
    return ((uint32_t)bytes[3] << 24) | ((uint32_t)bytes[2] << 16) | ((uint32_t)bytes[1] << 8) |
           bytes[0];
}

/* In software, four bits at a time: the CRC unit may be in the middle of a frame. The longest
 * command takes about 90 us. */
uint32_t crc_words(const uint8_t *bytes, uint32_t words)
{
    static const uint32_t table[16] = {
        0x00000000, 0x04C11DB7, 0x09823B6E, 0x0D4326D9, 0x130476DC, 0x17C56B6B,
        0x1A864DB2, 0x1E475005, 0x2608EDB8, 0x22C9F00F, 0x2F8AD6D6, 0x2B4BCB61,
        0x350C9B64, 0x31CD86D3, 0x3C8EA00A, 0x384FBDBD,
    };
    uint32_t crc = 0xFFFFFFFFu;
    for (uint32_t n = 0; n < words; n++) {
        crc ^= little_endian(bytes + 4u * n);
        for (uint32_t nibble = 0; nibble < 8u; nibble++)
            crc = (crc << 4) ^ table[crc >> 28];
    }
    return crc;
}

bool command_present(const uint8_t *bytes)
{
    return bytes[0] == COMMAND_MAGIC_0 && bytes[1] == COMMAND_MAGIC_1;
}

bool command_brief(const uint8_t *bytes)
{
    return command_present(bytes) && bytes[MODE_AT] == MODE_SPIKES && (bytes[15] & OPTION_BRIEF);
}

bool periods_valid(uint32_t sh_period, uint32_t icg_period)
{
    return sh_period >= SH_MIN && icg_period >= ICG_MIN && icg_period % sh_period == 0;
}

struct entry {
    uint64_t leds;
    uint32_t exposure;
    bool continues;
};

static uint32_t table_at(uint32_t mode)
{
    return mode == MODE_SPIKES ? SPIKES_TABLE_AT : STREAM_TABLE_AT;
}

static uint32_t entry_size(uint32_t mode)
{
    return mode == MODE_SPIKES ? SPIKES_ENTRY_SIZE : STREAM_ENTRY_SIZE;
}

static struct entry entry_read(const uint8_t *bytes, uint32_t index)
{
    const uint32_t mode = bytes[MODE_AT];
    const uint8_t *at = bytes + table_at(mode) + index * entry_size(mode);
    const uint32_t exposure = little_endian(at + 8);
    return (struct entry){
        .leds = ((uint64_t)little_endian(at + 4) << 32) | little_endian(at),
        .exposure = exposure & ~STREAM_EXPOSURE_CONTINUES,
        .continues = (exposure & STREAM_EXPOSURE_CONTINUES) != 0,
    };
}

/* Exposures of one frame fall, but for those of entries that light nothing, and the last frame is
 * complete. */
static bool table_ordered(const uint8_t *bytes, uint32_t entries)
{
    uint32_t before = UINT32_MAX;
    for (uint32_t n = 0; n < entries; n++) {
        const struct entry entry = entry_read(bytes, n);
        if (entry.exposure >= before && (entry.leds || entry.exposure))
            return false;
        before = entry.continues ? entry.exposure : UINT32_MAX;
    }
    return before == UINT32_MAX;
}

static bool table_read(const uint8_t *bytes, uint32_t entries, struct plan *plan)
{
    uint32_t steps = 0;
    uint64_t lit = 0;        /* in this frame so far */
    uint32_t latched = 0;    /* exposure at the last latch of this frame; 0: none */
    bool frame_begins = true;
    for (uint32_t n = 0; n < entries; n++) {
        const struct entry entry = entry_read(bytes, n);
        if (frame_begins) {
            plan->first_step[plan->frames++] = (uint8_t)steps;
            lit = 0;
            latched = 0;
        }
        frame_begins = !entry.continues;
        const uint64_t leds = entry.exposure ? lit | entry.leds : lit;
        if (entry.leds && entry.exposure &&
            (entry.exposure < STREAM_EXPOSURE_MIN || entry.exposure > plan->sh_period))
            return false;
        if (leds == lit)
            continue;
        const bool latch = (leds >> LED_CHAIN_FIRST) != (lit >> LED_CHAIN_FIRST);
        if (latch) {
            if (latched && latched - entry.exposure < LED_CHAIN_STEP)
                return false;
            latched = entry.exposure;
        }
        lit = leds;
        /* LEDs go out with the SH edge that ends the integration, SH_EDGE after ICG's */
        const uint32_t tick = plan->icg_period + SH_EDGE - entry.exposure;
        plan->steps[steps++] = (struct step){.leds = leds, .tick = tick, .latch = latch};
    }
    plan->first_step[plan->frames] = (uint8_t)steps;

    /* backwards, twice around, as the table is cyclic */
    uint8_t next = NO_STEP;
    for (uint32_t n = 2u * steps; n-- > 0;) {
        struct step *step = &plan->steps[n < steps ? n : n - steps];
        step->next_latch = next;
        if (step->latch)
            next = (uint8_t)(n < steps ? n : n - steps);
    }
    return true;
}

static bool overlaps(const struct window *window, const struct window *others, uint32_t count)
{
    for (uint32_t n = 0; n < count; n++)
        if (window->first <= others[n].last && others[n].first <= window->last)
            return true;
    return false;
}

/* Where spikes are looked for. Each frame has a window, and no pixel is in two: that bounds the time
 * it takes. */
static bool windows_read(const uint8_t *bytes, uint32_t entries, struct plan *plan)
{
    uint32_t windows = 0, frames = 0;
    plan->first_window[0] = 0;
    for (uint32_t n = 0; n < entries; n++) {
        const uint32_t both = little_endian(bytes + SPIKES_TABLE_AT + n * SPIKES_ENTRY_SIZE + 12u);
        const uint32_t first = both & 0xFFFFu, last = both >> 16;
        if (first != SPIKES_NO_WINDOW || last != SPIKES_NO_WINDOW) {
            if (last >= PIXELS || first + SPIKES_WINDOW_MIN > last + 1u)
                return false;
            const struct window window = {.first = (uint16_t)first, .last = (uint16_t)last};
            const uint32_t before = plan->first_window[frames];
            if (overlaps(&window, plan->windows + before, windows - before))
                return false;
            plan->windows[windows++] = window;
        }
        if (entry_read(bytes, n).continues)
            continue;
        const uint32_t of_frame = windows - plan->first_window[frames];
        if (of_frame < 1u || of_frame > SPIKES_WINDOWS_MAX)
            return false;
        plan->first_window[++frames] = (uint8_t)windows;
    }
    const uint32_t limits = little_endian(bytes + STREAM_TABLE_AT);
    plan->saturated = (uint16_t)limits;
    plan->threshold = (uint16_t)(limits >> 16);
    return plan->saturated <= FULL_SCALE && plan->threshold <= FULL_SCALE;
}

uint32_t command_read(const uint8_t *bytes, struct plan *plan)
{
    plan->sh_period = big_endian(bytes + 2);
    plan->icg_period = big_endian(bytes + 6);
    plan->mode = bytes[MODE_AT];
    plan->count = ((uint32_t)bytes[11] << 8) | bytes[12];
    plan->frames = 0;
    plan->await_sync = false;
    plan->first_step[0] = 0;

    const bool periods = periods_valid(plan->sh_period, plan->icg_period);
    if (plan->mode == MODE_ORIGINAL)
        return periods ? REFUSAL_NONE : REFUSAL_PERIODS;
    const uint32_t entries = bytes[14];
    const uint32_t version = bytes[13], options = bytes[15];
    if (version != SPIKES_VERSION &&
        (version != STREAM_VERSION || plan->mode == MODE_SPIKES || options))
        return REFUSAL_VERSION;
    if (options & ~(OPTION_AWAIT_SYNC | (plan->mode == MODE_SPIKES ? OPTION_BRIEF : 0u)))
        return REFUSAL_VERSION;
    plan->await_sync = (options & OPTION_AWAIT_SYNC) != 0;
    if (entries < 1u || entries > STREAM_TABLE_MAX)
        return REFUSAL_TABLE;
    const uint32_t end = table_at(plan->mode) + entries * entry_size(plan->mode);
    if (crc_words(bytes, end / 4u) != little_endian(bytes + end))
        return REFUSAL_CHECKSUM;
    if (plan->mode != MODE_STREAM && plan->mode != MODE_SPIKES)
        return REFUSAL_MODE;
    if (!table_ordered(bytes, entries))
        return REFUSAL_TABLE;
    if (!periods)
        return REFUSAL_PERIODS;
    if (!table_read(bytes, entries, plan))
        return REFUSAL_TABLE;
    if (plan->mode == MODE_SPIKES && !windows_read(bytes, entries, plan))
        return REFUSAL_TABLE;
    return REFUSAL_NONE;
}
