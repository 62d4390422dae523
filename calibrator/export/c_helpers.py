"""Functions of C that corrections call; a source file gets those that it needs.

C99 leaves open what a right shift of a negative number gives, and a conversion to a signed type that cannot hold it:
neither is used here.
"""

__all__ = ["AS_SIGNED", "CLAMP", "FLOOR_SHIFT", "WIDE"]

CLAMP = """\
static int64_t clamp(int64_t value, int64_t lowest, int64_t highest)
{
    return value < lowest ? lowest : (value > highest ? highest : value);
}
"""

FLOOR_SHIFT = """\
/* value / 2^shift, rounded down; shift is 1 to 63 */
static int64_t floor_shift(int64_t value, unsigned int shift)
{
    return value >= 0 ? value >> shift : -1 - ((-1 - value) >> shift);
}
"""

AS_SIGNED = """\
/* the two's complement of 64 bits */
static int64_t as_signed(uint64_t raw)
{
    return raw <= (uint64_t)INT64_MAX ? (int64_t)raw : -1 - (int64_t)(UINT64_MAX - raw);
}
"""

WIDE = """\
/* two's complement of 128 bits */
typedef struct {
    uint64_t high;
    uint64_t low;
} wide;

static wide wide_of(uint64_t high, uint64_t low)
{
    wide result;

    result.high = high;
    result.low = low;
    return result;
}

static wide wide_sum(wide a, wide b)
{
    const uint64_t low = a.low + b.low;

    return wide_of(a.high + b.high + (low < a.low ? 1U : 0U), low);
}

/* by halves of 32 bits of the magnitudes */
static wide wide_product(int64_t a, int64_t b)
{
    const uint64_t half = UINT64_C(0xFFFFFFFF);
    const uint64_t x = a < 0 ? 0U - (uint64_t)a : (uint64_t)a;
    const uint64_t y = b < 0 ? 0U - (uint64_t)b : (uint64_t)b;
    const uint64_t lowest = (x & half) * (y & half);
    const uint64_t middle = (x >> 32U) * (y & half) + (lowest >> 32U);
    const uint64_t other = (x & half) * (y >> 32U) + (middle & half);
    const uint64_t high = (x >> 32U) * (y >> 32U) + (middle >> 32U) + (other >> 32U);
    const uint64_t low = (other << 32U) | (lowest & half);

    return (a < 0) == (b < 0) ? wide_of(high, low) : wide_of(~high + (low == 0U ? 1U : 0U), 0U - low);
}

/* value / 2^shift, rounded down; the result fits, and shift is 1 to 126 */
static int64_t wide_floor_shift(wide value, unsigned int shift)
{
    const uint64_t sign = (value.high >> 63U) != 0U ? UINT64_MAX : 0U;

    if (shift < 64U) {
        return as_signed((value.low >> shift) | (value.high << (64U - shift)));
    }
    if (shift == 64U) {
        return as_signed(value.high);
    }
    return as_signed((value.high >> (shift - 64U)) | (sign << (128U - shift)));
}
"""
