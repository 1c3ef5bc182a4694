/* Cycles at 84 MHz, as the emulator counts them for clang's code (gcc's takes up to 25 % more): about
 * 60 for each block of 8 pixels, so 28,000 (0.33 ms) for the whole line and 700 for a window of 100
 * pixels, and for each spike 600 (6 px wide) to 4,000 (60 or 200 px). The whole line with eight
 * spikes takes 60,000 (0.71 ms) at most, of the 310,000 that a read-out lasts. */
#include "spikes.h"

#include <stdbool.h>

#define DARK_FIRST 16u /* the light-shielded elements D16 to D28 */
#define DARK_COUNT 13u
#define BLOCK 8u       /* pixels */
#define BLOCKS_MAX (PIXELS / BLOCK)
#define WIDE 8         /* blocks at half maximum from which on they are looked at instead of pixels */
#define NOISE_LEAST 40 /* of a block's sum; ten times that of a sensor in the dark */
#define REACH_MAX 144  /* half the kernel's length, pixels or blocks */
#define SEEN 288       /* pixels, from the top in which half of it is looked for */
#define FRACTION 1024  /* of a sample, fixed point */
#define LINE_END ((PIXELS - 1u) * SPIKES_POSITION_SCALE)
_Static_assert(SPIKES_POSITION_SCALE == FRACTION && SPIKES_WIDTH_SCALE * 64 == FRACTION, "shifts");

/* Blocks: between two valleys, the highest, or two with no deep valley between them. */
struct peak {
    int32_t left, top, right;
    int32_t lower;  /* light of the lowest of its tops */
    int32_t height; /* of the highest */
    bool twin;      /* it has several */
};

/* A window of the line, its first pixel and block being 0. */
static struct {
    const uint16_t *pixels;
    int32_t zero; /* code without light */
    int32_t length, blocks;
    int32_t threshold;
    uint32_t saturated;
    struct peak peaks[SPIKES_SPIKES_MAX]; /* the highest first */
    uint32_t count, most;
    int32_t light[BLOCKS_MAX]; /* of each block, counts */
} line;

static int32_t smaller(int32_t a, int32_t b)
{
    return a < b ? a : b;
}

static int32_t larger(int32_t a, int32_t b)
{
    return a > b ? a : b;
}

/* --- peaks ------------------------------------------------------------------------------------- */

static void sum_blocks(void)
{
    const uint16_t *pixel = line.pixels;
    for (int32_t n = 0; n < line.blocks; n++, pixel += BLOCK) {
        const uint32_t sum = (uint32_t)pixel[0] + pixel[1] + pixel[2] + pixel[3] + pixel[4] +
                             pixel[5] + pixel[6] + pixel[7];
        line.light[n] = (int32_t)BLOCK * line.zero - (int32_t)sum;
    }
}

/* Ten times the noise, of which the light's own and uneven pixels are a 16th of it. */
static int32_t least_rise(int32_t light)
{
    return line.threshold + (light > 0 ? light >> 4 : 0);
}

static void keep(struct peak peak)
{
    const int32_t *light = line.light;
    peak.height = light[peak.top] - smaller(light[peak.left], light[peak.right]);
    uint32_t n = line.count;
    if (n < line.most)
        line.count++;
    else if (line.peaks[--n].height >= peak.height)
        return;
    for (; n > 0 && line.peaks[n - 1u].height < peak.height; n--)
        line.peaks[n] = line.peaks[n - 1u];
    line.peaks[n] = peak;
}

/* Joins a peak to the one before it unless the valley between them is deep. */
static void take(struct peak *group, const struct peak *peak)
{
    const int32_t *light = line.light;
    if (group->top >= 0) {
        const int32_t base = smaller(light[group->left], light[peak->right]);
        const int32_t lower = smaller(light[group->top], light[peak->top]);
        if (2 * (light[peak->left] - base) > lower - base) {
            if (light[peak->top] > light[group->top])
                group->top = peak->top;
            group->right = peak->right;
            group->lower = smaller(group->lower, peak->lower);
            group->twin = true;
            return;
        }
        keep(*group);
    }
    *group = *peak;
}

/* Peaks and valleys in turn: each differs from the one before it by more than noise does. */
static void find_peaks(void)
{
    const int32_t *light = line.light;
    struct peak group = {.top = -1}, peak = {0};
    int32_t lowest = 0;
    bool climbing = true;
    line.count = 0;
    for (int32_t n = 1; n < line.blocks; n++) {
        if (climbing) {
            if (light[n] < light[lowest])
                lowest = n;
            if (light[n] > light[peak.top]) {
                peak.top = n;
                peak.left = lowest;
            } else if (light[peak.top] - light[n] > least_rise(light[peak.top])) {
                climbing = false;
                lowest = n;
            }
        } else if (light[n] < light[lowest]) {
            lowest = n;
        } else if (light[n] - light[lowest] > least_rise(light[n])) {
            peak.right = lowest;
            peak.lower = light[peak.top];
            take(&group, &peak);
            peak = (struct peak){.left = lowest, .top = n};
            climbing = true;
        }
    }
    if (climbing) {
        lowest = peak.top; /* after the top there is no valley: the lowest there */
        for (int32_t n = peak.top + 1; n < line.blocks; n++)
            if (light[n] < light[lowest])
                lowest = n;
    }
    peak.right = lowest;
    peak.lower = light[peak.top];
    if (!climbing || light[peak.top] - light[peak.left] > least_rise(light[peak.top]))
        take(&group, &peak);
    if (group.top >= 0)
        keep(group);
}

/* --- one peak ---------------------------------------------------------------------------------- */

/* Light of a block or a pixel; which of them is known when this is compiled. */
static inline int32_t sample(bool wide, int32_t n)
{
    return wide ? line.light[n] : line.zero - line.pixels[n];
}

/* Twice the middle between base and top is not reached by n and the one beyond it. */
static inline bool below(bool wide, int32_t n, int32_t beyond, int32_t twice, int32_t end)
{
    return 2 * sample(wide, n) < twice && (n == end || 2 * sample(wide, beyond) < twice);
}

/* Where light falls to half, going from `at` in steps of -1 or 1 to `end` at most; in fractions of
 * a sample. Whether it does not fall so far is added to `reached`. */
static inline int32_t half_place(bool wide, int32_t at, int32_t step, int32_t end, int32_t twice,
                                 bool *reached)
{
    int32_t n = at;
    while (n != end && !below(wide, n + step, n + 2 * step, twice, end))
        n += step;
    if (n == end) {
        *reached = true;
        return n * FRACTION + step * FRACTION / 2;
    }
    const int32_t inside = sample(wide, n), outside = sample(wide, n + step);
    return n * FRACTION + step * ((2 * inside - twice) * (FRACTION / 2) / (inside - outside));
}

/* The derivative of light smoothed by (1 - (x/reach)^2)^2: positive left of a spike's middle. */
static inline int64_t slope(bool wide, int32_t at, int32_t reach)
{
    const int32_t square = reach * reach;
    int64_t sum = 0;
    if (wide) {
        const int32_t *right = line.light + at, *left = right;
        for (int32_t x = 1; x < reach; x++)
            sum += (int64_t)(x * (square - x * x)) * (*++right - *--left);
    } else {
        const uint16_t *right = line.pixels + at, *left = right;
        for (int32_t x = 1; x < reach; x++)
            sum += (int64_t)(x * (square - x * x)) * (*--left - *++right);
    }
    return sum;
}

/* Where the slope changes its sign, in fractions of a sample; -1 if it does not. */
static inline int32_t crossing(bool wide, int32_t at, int32_t reach, int32_t first, int32_t last)
{
    int64_t before = slope(wide, at, reach), after = before;
    int32_t low = at, high = at, step = 1;
    if (before >= 0) {
        do {
            if (high == last)
                return -1;
            low = high;
            before = after;
            high = smaller(high + step, last);
            step *= 2;
            after = slope(wide, high, reach);
        } while (after >= 0);
    } else {
        do {
            if (low == first)
                return -1;
            high = low;
            after = before;
            low = larger(low - step, first);
            step *= 2;
            before = slope(wide, low, reach);
        } while (before < 0);
    }
    while (high - low > 1) {
        const int32_t middle = (low + high) / 2;
        const int64_t found = slope(wide, middle, reach);
        if (found >= 0) {
            low = middle;
            before = found;
        } else {
            high = middle;
            after = found;
        }
    }
    /* 32 bits are enough, and the processor divides by no more */
    uint64_t part = (uint64_t)before, whole = (uint64_t)(before - after);
    while (whole >= 1u << 21) {
        whole >>= 1;
        part >>= 1;
    }
    const uint32_t divisor = (uint32_t)whole;
    return low * FRACTION + (int32_t)(((uint32_t)part * FRACTION + divisor / 2u) / divisor);
}

static bool saturated(int32_t first, int32_t last)
{
    for (int32_t n = larger(first, 0); n <= last && n < line.length; n++)
        if (line.pixels[n] <= line.saturated)
            return true;
    return false;
}

/* How many blocks around the top are above half, of the lower one if there are two. */
static int32_t blocks_above(const struct peak *peak, int32_t base)
{
    const int32_t *light = line.light;
    const int32_t half = base + ((peak->lower - base) >> 1);
    int32_t first = peak->top, last = peak->top;
    while (first > peak->left && light[first - 1] > half)
        first--;
    while (last < peak->right && light[last + 1] > half)
        last++;
    return last - first + 1;
}

/* Of a sample's place, where in the line of pixels it is; both in fractions. */
static int32_t pixel_place(bool wide, int32_t place)
{
    return wide ? (int32_t)BLOCK * place + (int32_t)(BLOCK - 1u) * FRACTION / 2 : place;
}

/* Where the derivative of smoothed light is zero near `place`, in fractions of a pixel; -1 if there
 * is too little light on either side to tell. Light of this peak reaches from first to last. */
static inline int32_t derivative_zero(bool wide, int32_t place, int32_t width, int32_t first,
                                      int32_t last, bool *cut)
{
    const int32_t bits = wide ? 13 : 10, half = 1 << (bits - 1);
    const int32_t middle = (place - pixel_place(wide, 0) + half) >> bits;
    /* so long a kernel has the least noise; a shorter one does where light ends */
    const int32_t wanted = larger((width + width / 8 + half) >> bits, 4);
    const int32_t room = smaller(middle - first, last - middle);
    const int32_t reach = smaller(smaller(wanted, room), REACH_MAX);
    if (reach < 3 || 2 * reach << bits < width) {
        *cut = room < wanted;
        return -1;
    }
    const int32_t zero = crossing(wide, middle, reach, first + reach, last - reach);
    return zero < 0 ? -1 : pixel_place(wide, zero);
}

static void refine(const struct peak *peak, struct spike *spike)
{
    const int32_t *light = line.light;
    const int32_t block = (int32_t)BLOCK;
    const bool begins = peak->left == 0, ends = peak->right == line.blocks - 1;
    const int32_t first = peak->left * block;
    const int32_t last = ends ? line.length - 1 : peak->right * block + block - 1;

    const int32_t around = 2 * blocks_above(peak, smaller(light[peak->left], light[peak->right])) + 4;
    int32_t base = light[peak->top];
    const int32_t base_last = smaller(peak->right, peak->top + around);
    for (int32_t n = larger(peak->left, peak->top - around); n <= base_last; n++)
        base = smaller(base, light[n]);

    bool open_left = false, open_right = false;
    int32_t left, right, height;
    if (peak->twin || blocks_above(peak, base) >= WIDE) {
        const int32_t twice = peak->lower + base;
        left = half_place(true, peak->top, -1, peak->left, twice, &open_left);
        right = half_place(true, peak->top, 1, peak->right, twice, &open_right);
        left = pixel_place(true, left);
        right = pixel_place(true, right);
        height = (light[peak->top] - base) / block;
    } else {
        const int32_t end = smaller(peak->top * block + 2 * block - 1, last);
        int32_t at = larger(peak->top * block - block, first);
        for (int32_t n = at; n <= end; n++)
            if (line.pixels[n] < line.pixels[at])
                at = n;
        const int32_t top = line.zero - line.pixels[at];
        base >>= 3;
        left = half_place(false, at, -1, larger(first, at - SEEN), top + base, &open_left);
        right = half_place(false, at, 1, smaller(last, at + SEEN), top + base, &open_right);
        height = top - base;
    }
    const int32_t width = right - left;
    int32_t place = (left + right) >> 1;
    bool cut = false;
    const int32_t zero =
        width >= WIDE * block * FRACTION
            ? derivative_zero(true, place, width, peak->left, peak->right, &cut)
            : derivative_zero(false, place, width, first, last, &cut);
    if (zero >= 0)
        place = zero;

    uint8_t flags = 0;
    if (peak->twin || (open_left && !begins) || (open_right && !ends))
        flags |= SPIKE_DOUBLE;
    if ((open_left && begins) || (open_right && ends) || (cut && (begins || ends)))
        flags |= SPIKE_CLIPPED;
    if (saturated(left >> 10, right >> 10))
        flags |= SPIKE_SATURATED;
    spike->position = (uint32_t)larger(place, 0);
    spike->width = (uint16_t)smaller(width >> 6, UINT16_MAX);
    spike->height = (uint16_t)smaller(larger(height, 0), UINT16_MAX);
    spike->flags = flags;
}

/* --- all of them ------------------------------------------------------------------------------- */

static void find_in(const struct window *window, uint32_t number, struct found *found)
{
    line.length = window->last - window->first + 1;
    line.blocks = line.length / (int32_t)BLOCK;
    sum_blocks();
    find_peaks();
    struct spike *spikes = found->spikes + found->count;
    for (uint32_t n = 0; n < line.count; n++) {
        struct spike spike = {0};
        refine(&line.peaks[n], &spike);
        const uint32_t place = spike.position + window->first * SPIKES_POSITION_SCALE;
        spike.position = place < LINE_END ? place : LINE_END;
        spike.window = (uint8_t)number;
        uint32_t at = n;
        for (; at > 0 && spikes[at - 1u].height < spike.height; at--)
            spikes[at] = spikes[at - 1u];
        spikes[at] = spike;
    }
    for (uint32_t n = 0; n < line.count; n++)
        for (uint32_t other = n + 1u; other < line.count; other++) {
            const uint32_t a = spikes[n].position, b = spikes[other].position;
            const uint32_t apart = a > b ? a - b : b - a;
            if (2u * spikes[other].height <= spikes[n].height &&
                apart <= 4u * 64u * spikes[n].width)
                spikes[n].flags |= SPIKE_REFLECTION;
        }
    found->count = (uint8_t)(found->count + line.count);
}

void spikes_find(const uint16_t *elements, const struct search *search, struct found *found)
{
    const uint16_t *dark = elements + DARK_FIRST;
    uint32_t sum = 0;
    int32_t changes = 0; /* 12 times the noise; between elements of the same kind, odd or even */
    for (uint32_t n = 0; n < DARK_COUNT; n++) {
        sum += dark[n];
        if (n >= 2u)
            changes += dark[n] > dark[n - 2u] ? dark[n] - dark[n - 2u] : dark[n - 2u] - dark[n];
    }
    const uint32_t level = (SPIKES_DARK_SCALE * sum + DARK_COUNT / 2u) / DARK_COUNT;
    found->count = 0;
    found->window_count = search->count;
    found->reserved = 0;
    found->dark = (uint16_t)smaller((int32_t)level, UINT16_MAX);
    line.zero = (int32_t)((sum + DARK_COUNT / 2u) / DARK_COUNT);
    line.saturated = search->saturated;
    line.threshold = search->threshold ? search->threshold : larger(3 * changes, NOISE_LEAST);
    for (uint32_t n = 0; n < search->count; n++) {
        const struct window *window = &search->windows[n];
        found->windows[n] = *window;
        line.pixels = elements + LEADING_ELEMENTS + window->first;
        line.most = SPIKES_SPIKES_MAX - found->count - (search->count - 1u - n);
        find_in(window, n, found);
    }
    for (uint32_t n = search->count; n < SPIKES_WINDOWS_MAX; n++)
        found->windows[n] = (struct window){0};
    for (uint32_t n = found->count; n < SPIKES_SPIKES_MAX; n++)
        found->spikes[n] = (struct spike){0};
}
