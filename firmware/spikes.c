/* Cycles at 84 MHz, as the emulator counts them for clang's code: about 50 for each block of 8 pixels,
 * so 28,000 (0.34 ms) for the whole line, and for each spike 1,500 (6 px wide) to 5,000 (60 px, or
 * as skewed as a sawtooth). Windows do not overlap, so that the most is the whole line with eight such
 * spikes: 69,000 (0.82 ms) of the 310,000 that a read-out lasts. */
#include "spikes.h"

#include <stdbool.h>

#define BLOCK 8u /* pixels */
#define BLOCKS_MAX (PIXELS / BLOCK)
#define WIDE 8         /* blocks at half maximum from which on they are looked at instead of pixels */
#define NOISE_LEAST 40 /* of a block's sum; ten times that of a sensor in the dark */
#define REACH_MAX 144  /* half the kernel's length, pixels or blocks */
#define SEEN 288       /* pixels, from the top in which half of it is looked for */
#define FRACTION 1024  /* of a sample, fixed point */
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
    int32_t length, blocks; /* the last block overlaps the one before it if it must */
    int32_t noise;          /* of a pixel in the dark, 12 times */
    int32_t threshold;
    int32_t saturated; /* light */
    struct peak peaks[SPIKES_SPIKES_MAX]; /* the highest first */
    uint32_t count, most;
    bool alone; /* all light is of one LED */
    int32_t light[BLOCKS_MAX];  /* of each block, counts */
    int32_t weights[REACH_MAX]; /* of the kernel, from 1 */
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

/* First pixel of a block. */
static int32_t block_start(int32_t n)
{
    return smaller(n * (int32_t)BLOCK, line.length - (int32_t)BLOCK);
}

/* Two pixels at a time, each in half of a word: codes have 12 bits. */
static int32_t block_light(const uint16_t *pixels)
{
    uint32_t pairs[BLOCK / 2u];
    __builtin_memcpy(pairs, pixels, sizeof pairs);
    const uint32_t sums = pairs[0] + pairs[1] + pairs[2] + pairs[3];
    return (int32_t)BLOCK * line.zero - (int32_t)((sums & 0xFFFFu) + (sums >> 16));
}

static void sum_blocks(void)
{
    const uint16_t *pixels = line.pixels;
    for (int32_t n = 0; n < line.blocks - 1; n++, pixels += BLOCK)
        line.light[n] = block_light(pixels);
    line.light[line.blocks - 1] = block_light(line.pixels + line.length - BLOCK);
}

/* Of the light, a 16th is for its own noise and for uneven pixels. */
static int32_t least_rise(int32_t light)
{
    return line.threshold + (light > 0 ? light >> 4 : 0);
}

/* All of a peak's light is in one pixel: no LED is so sharp. */
static bool is_hot_pixel(const struct peak *peak, int32_t base)
{
    const uint16_t *pixels = line.pixels;
    const int32_t start = block_start(peak->top);
    int32_t at = start;
    for (int32_t n = start + 1; n < start + (int32_t)BLOCK; n++)
        if (pixels[n] < pixels[at])
            at = n;
    if (at < 2 || at + 2 >= line.length)
        return false;
    const int32_t beside = 4 * line.zero - (base >> 1) - pixels[at - 2] - pixels[at - 1] -
                           pixels[at + 1] - pixels[at + 2];
    return 2 * beside <= 3 * line.noise &&
           4 * (line.zero - (base >> 3) - pixels[at]) >= 3 * peak->height;
}

static void keep(struct peak peak)
{
    const int32_t *light = line.light;
    const int32_t base = smaller(light[peak.left], light[peak.right]);
    peak.height = light[peak.top] - base;
    uint32_t n = line.count;
    if ((n == line.most && line.peaks[n - 1u].height >= peak.height) ||
        peak.height <= line.threshold + (base > 0 ? base >> 3 : 0) || is_hot_pixel(&peak, base))
        return;
    if (n < line.most)
        line.count++;
    else
        n--;
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

/* Of the derivative of (1 - (x/reach)^2)^2. */
static void weigh(int32_t reach)
{
    const int32_t square = reach * reach;
    for (int32_t x = 1; x < reach; x++)
        line.weights[x] = x * (square - x * x);
}

/* The derivative of light so smoothed: positive left of a spike's middle. */
static inline int64_t slope(bool wide, int32_t at, int32_t reach)
{
    const int32_t *weight = line.weights;
    int64_t sum = 0;
    if (wide) {
        const int32_t *right = line.light + at, *left = right;
        for (int32_t x = 1; x < reach; x++)
            sum += (int64_t)*++weight * (*++right - *--left);
    } else {
        const uint16_t *right = line.pixels + at, *left = right;
        for (int32_t x = 1; x < reach; x++)
            sum += (int64_t)*++weight * (*--left - *++right);
    }
    return sum;
}

/* Of two numbers, neither negative, part below whole: their ratio in fractions, rounded. */
static int32_t ratio(int64_t part, int64_t whole)
{
    /* 32 bits are enough, and the processor divides by no more; slopes have 45 at most */
    const uint32_t high = (uint32_t)(whole >> 21);
    const uint32_t shift = high ? 32u - (uint32_t)__builtin_clz(high) : 0;
    const uint32_t divisor = (uint32_t)(whole >> shift);
    return (int32_t)(((uint32_t)(part >> shift) * FRACTION + divisor / 2u) / divisor);
}

/* Where the slope changes its sign, in fractions of a sample; -1 if it does not. */
static inline int32_t crossing(bool wide, int32_t at, int32_t reach, int32_t first, int32_t last)
{
    weigh(reach);
    int64_t before = slope(wide, at, reach), after = before;
    int32_t low = at, high = at, step = larger(reach >> 4, 1);
    if (before >= 0) {
        do {
            if (high == last)
                return -1;
            low = high;
            before = after;
            high = smaller(high + step, last);
            step *= 4;
            after = slope(wide, high, reach);
        } while (after >= 0);
    } else {
        do {
            if (low == first)
                return -1;
            high = low;
            after = before;
            low = larger(low - step, first);
            step *= 4;
            before = slope(wide, low, reach);
        } while (before < 0);
    }
    /* where a straight line crosses, which is close; every third time the middle, to be sure */
    for (uint32_t n = 1; high - low > 1; n++) {
        const int32_t line_crosses = (high - low) * ratio(before, before - after) / FRACTION;
        const int32_t inner = smaller(larger(line_crosses, 1), high - low - 1);
        const int32_t next = low + (n % 3u ? inner : (high - low) / 2);
        const int64_t found = slope(wide, next, reach);
        if (found >= 0) {
            low = next;
            before = found;
        } else {
            high = next;
            after = found;
        }
    }
    return low * FRACTION + ratio(before, before - after);
}

/* Light of the brightest pixel of those. */
static int32_t brightest(int32_t first, int32_t last)
{
    int32_t code = line.pixels[first];
    for (int32_t n = first + 1; n <= last; n++)
        code = smaller(code, line.pixels[n]);
    return line.zero - code;
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
                                      int32_t last)
{
    const int32_t bits = wide ? 13 : 10, half = 1 << (bits - 1);
    const int32_t middle = (place - pixel_place(wide, 0) + half) >> bits;
    /* so long a kernel has the least noise; a shorter one does where light ends */
    const int32_t wanted = larger((width + width / 8 + half) >> bits, 4);
    const int32_t room = smaller(middle - first, last - middle);
    const int32_t reach = smaller(smaller(wanted, room), REACH_MAX);
    if (reach < 3 || 2 * reach << bits < width)
        return -1;
    const int32_t zero = crossing(wide, middle, reach, first + reach, last - reach);
    return zero < 0 ? -1 : pixel_place(wide, zero);
}

/* What a second peak is: if no other LED is lit, a weaker one is a reflection. */
static uint8_t second(int32_t height, int32_t highest)
{
    return line.alone && 2 * height <= highest ? SPIKE_REFLECTION : SPIKE_DOUBLE;
}

static void refine(const struct peak *peak, struct spike *spike)
{
    const int32_t *light = line.light;
    const int32_t block = (int32_t)BLOCK;
    const bool begins = peak->left == 0, ends = peak->right == line.blocks - 1;
    const int32_t first = peak->left * block;
    const int32_t last = block_start(peak->right) + block - 1;
    /* of blocks at even distances */
    const int32_t right_block = smaller(peak->right, line.length / block - 1);
    const int32_t top_block = smaller(peak->top, right_block);

    const int32_t around = 2 * blocks_above(peak, smaller(light[peak->left], light[peak->right])) + 4;
    int32_t base = light[peak->top];
    const int32_t base_last = smaller(peak->right, peak->top + around);
    for (int32_t n = larger(peak->left, peak->top - around); n <= base_last; n++)
        base = smaller(base, light[n]);

    bool open_left = false, open_right = false;
    int32_t left, right, height, most; /* most: light of a pixel */
    if (peak->twin || blocks_above(peak, base) >= WIDE) {
        const int32_t twice = peak->lower + base;
        left = half_place(true, top_block, -1, peak->left, twice, &open_left);
        right = half_place(true, top_block, 1, right_block, twice, &open_right);
        left = pixel_place(true, left);
        right = pixel_place(true, right);
        height = (light[peak->top] - base) / block;
        most = brightest(block_start(peak->top), block_start(peak->top) + block - 1);
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
        most = top;
    }
    const int32_t width = right - left;
    int32_t place = (left + right) >> 1;
    const int32_t zero =
        width >= WIDE * block * FRACTION
            ? derivative_zero(true, place, width, peak->left, right_block)
            : derivative_zero(false, place, width, first, last);
    if (zero >= 0)
        place = zero;

    const int32_t end = (line.length - 1) * FRACTION;
    uint8_t flags = 0;
    if ((open_left && !begins) || (open_right && !ends))
        flags |= SPIKE_DOUBLE;
    else if (peak->twin)
        flags |= second(peak->lower - base, light[peak->top] - base);
    if ((open_left && begins) || (open_right && ends) || place < width || place + width > end)
        flags |= SPIKE_CLIPPED;
    if (line.saturated && most >= line.saturated)
        flags |= SPIKE_SATURATED;
    spike->position = (uint32_t)smaller(larger(place, 0), end);
    spike->width = (uint16_t)smaller(width >> 6, UINT16_MAX);
    spike->height = (uint16_t)smaller(larger(height, 0), UINT16_MAX);
    spike->flags = flags;
}

/* --- all of them ------------------------------------------------------------------------------- */

static void find_in(const struct window *window, uint32_t number, struct found *found)
{
    line.length = window->last - window->first + 1;
    line.blocks = (line.length + (int32_t)BLOCK - 1) / (int32_t)BLOCK;
    sum_blocks();
    find_peaks();
    struct spike *spikes = found->spikes + found->count;
    for (uint32_t n = 0; n < line.count; n++) {
        struct spike spike = {0};
        refine(&line.peaks[n], &spike);
        spike.position += window->first * SPIKES_POSITION_SCALE;
        spike.window = (uint8_t)number;
        uint32_t at = n;
        for (; at > 0 && spikes[at - 1u].height < spike.height; at--)
            spikes[at] = spikes[at - 1u];
        spikes[at] = spike;
    }
    for (uint32_t n = 1; line.alone && n < line.count; n++) {
        const uint32_t a = spikes[0].position, b = spikes[n].position;
        if ((a > b ? a - b : b - a) <= 4u * 64u * spikes[0].width)
            spikes[0].flags |= second(spikes[n].height, spikes[0].height);
    }
    found->count = (uint8_t)(found->count + line.count);
}

void spikes_find(const uint16_t *elements, const struct search *search, struct found *found)
{
    const uint16_t *dark = elements + DARK_FIRST;
    uint32_t sum = 0;
    line.noise = 0; /* differences between elements of the same kind, odd or even */
    for (uint32_t n = 0; n < DARK_COUNT; n++) {
        sum += dark[n];
        if (n >= 2u)
            line.noise += dark[n] > dark[n - 2u] ? dark[n] - dark[n - 2u] : dark[n - 2u] - dark[n];
    }
    const uint32_t level = (SPIKES_DARK_SCALE * sum + DARK_COUNT / 2u) / DARK_COUNT;
    found->count = 0;
    found->window_count = search->count;
    found->reserved = 0;
    found->dark = (uint16_t)smaller((int32_t)level, UINT16_MAX);
    line.zero = (int32_t)((sum + DARK_COUNT / 2u) / DARK_COUNT);
    line.saturated = search->saturated;
    line.threshold = search->threshold ? search->threshold : larger(5 * line.noise, NOISE_LEAST);
    line.alone = search->alone;
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
