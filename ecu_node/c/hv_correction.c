/* See hv_correction.h. */
#include "hv_correction.h"

#define SHIFT 58U /* bits of gains and fractions below one code */
#define ONE_CODE INT64_C(288230376151711744) /* 2^SHIFT */
#define ANY 0xFFU /* expected counter: the first intact frame may have any */
#define INIT 0U /* states of a message in AUTOSAR's E2E state machine */
#define VALID 1U
#define INVALID 2U
#define LOW_HALF 0xFFFFFFFFU

typedef enum { OK, LOST, REPEATED, JUMPED, CORRUPT } check_t;

typedef struct { /* 128 bits, two's complement */
    uint64_t high;
    uint64_t low;
} wide_t;

static int64_t to_signed(uint64_t word) /* avoids the conversion whose result C leaves to the compiler */
{
    const uint64_t inverted = ~word;
    return (word <= (uint64_t)INT64_MAX) ? (int64_t)word : (-(int64_t)inverted - 1);
}

static uint64_t magnitude(int64_t number)
{
    return (number < 0) ? (~(uint64_t)number + 1U) : (uint64_t)number;
}

static wide_t wide_sum(wide_t a, wide_t b)
{
    wide_t sum;
    sum.low = a.low + b.low;
    sum.high = a.high + b.high + ((sum.low < a.low) ? 1U : 0U);
    return sum;
}

static wide_t wide_product(int64_t a, int64_t b)
{
    const uint64_t x = magnitude(a);
    const uint64_t y = magnitude(b);
    const uint64_t low = (x & LOW_HALF) * (y & LOW_HALF);
    const uint64_t first = ((x >> 32U) * (y & LOW_HALF)) + (low >> 32U);
    const uint64_t second = ((x & LOW_HALF) * (y >> 32U)) + (first & LOW_HALF);
    wide_t product;
    product.high = ((x >> 32U) * (y >> 32U)) + (first >> 32U) + (second >> 32U);
    product.low = (second << 32U) | (low & LOW_HALF);
    if ((a < 0) != (b < 0)) {
        product.high = ~product.high + ((product.low == 0U) ? 1U : 0U);
        product.low = ~product.low + 1U;
    }
    return product;
}

static bool is_one_of(int64_t code, const int64_t *codes, size_t count)
{
    bool found = false;
    for (size_t k = 0U; k < count; k++) {
        found = found || (codes[k] == code);
    }
    return found;
}

static bool is_value(const hv_signal_t *signal, int64_t code)
{
    return (code >= signal->lowest) && (code <= signal->highest) &&
           !is_one_of(code, signal->named, signal->named_count);
}

int64_t hv_correct(const hv_branch_t *branch, const hv_values_t *values, int64_t code, const int64_t *voltage_code)
{
    const bool needs_voltage = (branch->voltage != NULL) && (values->voltage_gain != 0);
    int64_t result = code;
    if ((values->applied == 1U) && is_value(&branch->current, code) &&
        (!needs_voltage || ((voltage_code != NULL) && is_value(branch->voltage, *voltage_code)))) {
        wide_t sum = {0U, values->fraction};
        sum = wide_sum(sum, wide_product(code, values->gain));
        sum = wide_sum(sum, wide_product(values->bias, ONE_CODE));
        if (needs_voltage) {
            sum = wide_sum(sum, wide_product(*voltage_code, values->voltage_gain));
        }
        const uint64_t top = sum.high >> (SHIFT - 1U); /* sign of the result, and its bits beyond 64 */
        if ((top != 0U) && (top != (UINT64_MAX >> (SHIFT - 1U)))) {
            result = ((sum.high >> 63U) != 0U) ? branch->lowest : branch->highest;
        } else {
            result = to_signed((sum.high << (64U - SHIFT)) | (sum.low >> SHIFT));
            result = (result < branch->lowest) ? branch->lowest : result;
            result = (result > branch->highest) ? branch->highest : result;
        }
    }
    return result;
}

static size_t bytes_of(const hv_place_t *place)
{
    return ((size_t)place->shift + (size_t)place->bits + 7U) / 8U;
}

static bool is_inside(const hv_place_t *place, size_t length)
{
    const size_t bytes = bytes_of(place);
    const size_t end = (size_t)place->byte + (place->is_big ? (size_t)1U : bytes);
    return (end <= length) && (bytes <= end);
}

static size_t byte_at(const hv_place_t *place, size_t k) /* the k-th byte of a signal, from the least significant one */
{
    return place->is_big ? ((size_t)place->byte - k) : ((size_t)place->byte + k);
}

static int64_t read_code(const hv_place_t *place, const uint8_t *payload)
{
    const size_t bytes = bytes_of(place);
    const uint64_t ones = UINT64_MAX >> (64U - place->bits);
    uint64_t word = (uint64_t)payload[place->byte] >> place->shift;
    for (size_t k = 1U; k < bytes; k++) {
        word |= (uint64_t)payload[byte_at(place, k)] << ((8U * k) - place->shift);
    }
    word &= ones;
    if (place->is_signed && ((word & ~(ones >> 1U)) != 0U)) {
        word |= ~ones;
    }
    return to_signed(word);
}

static void write_code(const hv_place_t *place, uint8_t *payload, int64_t code)
{
    const size_t bytes = bytes_of(place);
    const uint64_t ones = UINT64_MAX >> (64U - place->bits);
    const uint64_t word = (uint64_t)code & ones;
    for (size_t k = 0U; k < bytes; k++) {
        const size_t up = 8U * k;
        const uint64_t mask = (k == 0U) ? (ones << place->shift) : (ones >> (up - place->shift));
        const uint64_t bits = (k == 0U) ? (word << place->shift) : (word >> (up - place->shift));
        uint8_t *const target = &payload[byte_at(place, k)];
        *target = (uint8_t)((*target & ~mask & 0xFFU) | (bits & 0xFFU));
    }
}

static bool is_present(const hv_signal_t *signal, const uint8_t *payload, size_t length)
{
    bool present = is_inside(&signal->place, length);
    for (size_t k = 0U; present && (k < signal->selector_count); k++) {
        const hv_selector_t *const selector = &signal->selectors[k];
        present = is_inside(&selector->place, length) &&
                  is_one_of(read_code(&selector->place, payload), selector->codes, selector->count);
    }
    return present;
}

/* whether a payload is too short for a signal, or to tell whether it has it */
static bool is_cut(const hv_signal_t *signal, size_t length)
{
    bool cut = !is_inside(&signal->place, length);
    for (size_t k = 0U; !cut && (k < signal->selector_count); k++) {
        cut = !is_inside(&signal->selectors[k].place, length);
    }
    return cut;
}

static uint8_t crc8(uint8_t crc, uint8_t byte, uint8_t polynomial)
{
    uint32_t word = (uint32_t)crc ^ byte;
    for (uint8_t k = 0U; k < 8U; k++) {
        word = ((word & 0x80U) != 0U) ? ((word << 1U) ^ polynomial) : (word << 1U);
    }
    return (uint8_t)(word & 0xFFU);
}

static uint8_t crc_of(const hv_message_t *message, const uint8_t *payload, size_t length)
{
    const bool is_p02 = message->profile == HV_P02;
    const uint8_t polynomial = is_p02 ? 0x2FU : 0x1DU;
    const uint8_t counter = payload[message->offset + 1U] & 0x0FU;
    uint8_t crc = is_p02 ? 0xFFU : 0U;
    if (message->profile == HV_P01_ALTERNATING) {
        crc = crc8(crc, message->data_id[counter & 1U], polynomial);
    } else if (!is_p02) {
        crc = crc8(crc, message->data_id[0], polynomial);
        if (message->profile != HV_P01_LOW) {
            crc = crc8(crc, (message->profile == HV_P01_BOTH) ? message->data_id[1] : 0U, polynomial);
        }
    } else {
        /* profile 2 takes its data identifier at the end */
    }
    for (size_t k = 0U; k < length; k++) {
        if (k != message->offset) {
            crc = crc8(crc, payload[k], polynomial);
        }
    }
    return is_p02 ? (crc8(crc, message->data_id[counter], polynomial) ^ 0xFFU) : crc;
}

static bool is_usable(check_t check)
{
    return (check == OK) || (check == LOST);
}

static check_t check_of(const hv_message_t *message, const uint8_t *payload, size_t length, uint8_t *expected)
{
    const uint8_t modulus = (message->profile == HV_P02) ? 16U : 15U;
    check_t check = OK;
    if (message->profile != HV_UNPROTECTED) {
        check = CORRUPT;
        if ((length >= ((size_t)message->offset + 2U)) &&
            (payload[message->offset] == crc_of(message, payload, length))) {
            const uint8_t second = payload[message->offset + 1U];
            const uint8_t counter = second & 0x0FU;
            const bool is_own = (message->profile != HV_P01_NIBBLE) || ((second >> 4U) == (message->data_id[1] & 0x0FU));
            if (is_own && (counter < modulus)) {
                const uint8_t next = (counter == (modulus - 1U)) ? 0U : (uint8_t)(counter + 1U);
                const uint8_t step = (*expected == ANY) ? 1U : (uint8_t)(((next + modulus) - *expected) % modulus);
                *expected = next;
                if (step == 0U) {
                    check = REPEATED;
                } else if (step == 1U) {
                    check = OK;
                } else {
                    check = (step <= message->max_step) ? LOST : JUMPED;
                }
            }
        }
    }
    return check;
}

static uint64_t ones_in(uint64_t word, uint8_t bits) /* among its lowest bits */
{
    uint64_t ones = 0U;
    uint64_t rest = word;
    for (uint8_t k = 0U; k < bits; k++) {
        ones += rest & 1U;
        rest >>= 1U;
    }
    return ones;
}

/* Update the state of a message. A repeated frame, or one that jumped, is neither usable nor an error. */
static void judge(const hv_message_t *message, hv_received_t *received, check_t check)
{
    const hv_window_t *const window = &message->window[received->state];
    const bool is_before_first = (received->state == INIT) && (received->expected == ANY); /* only corrupt ones came */
    if ((window->frames != 0U) && !is_before_first) {
        received->usable = (received->usable << 1U) | (is_usable(check) ? 1U : 0U);
        received->corrupt = (received->corrupt << 1U) | ((check == CORRUPT) ? 1U : 0U);
        const bool has_errors = ones_in(received->corrupt, window->frames) > window->max_error;
        if (!has_errors && (ones_in(received->usable, window->frames) >= window->min_ok)) {
            received->state = VALID;
        } else if (has_errors || (received->state == VALID)) {
            received->state = INVALID;
        } else {
            /* as it was */
        }
    }
}

static hv_result_t forward(const hv_layout_t *layout, const hv_calibration_t *calibration, hv_state_t *state,
                           size_t number, uint8_t *payload, size_t length)
{
    const hv_message_t *const message = &layout->messages[number];
    hv_received_t *const received = &state->message[number];
    const check_t check = check_of(message, payload, length, &received->expected);
    hv_result_t result = HV_SAME;
    judge(message, received, check);
    for (size_t k = 0U; k < layout->branch_count; k++) {
        if ((received->state == INVALID) && (layout->branches[k].voltage_message == number)) {
            state->has_voltage[k] = false;
        }
    }
    if (!is_usable(check)) {
        result = message->has_branches ? HV_HELD_BACK : HV_SAME;
    } else if (calibration->layout == layout->digest) {
        for (size_t k = 0U; k < layout->branch_count; k++) { /* voltages first: a frame may have both */
            const hv_branch_t *const branch = &layout->branches[k];
            const bool is_due = (branch->voltage != NULL) && (branch->voltage_message == number);
            if (is_due && is_cut(branch->voltage, length)) {
                state->has_voltage[k] = false;
            } else if (is_due && (received->state != INVALID) && is_present(branch->voltage, payload, length)) {
                state->voltage[k] = read_code(&branch->voltage->place, payload);
                state->has_voltage[k] = true;
            } else {
                /* as it was */
            }
        }
        for (size_t k = 0U; k < layout->branch_count; k++) {
            const hv_branch_t *const branch = &layout->branches[k];
            if ((branch->message == number) && is_present(&branch->current, payload, length)) {
                const int64_t code = read_code(&branch->current.place, payload);
                const int64_t *const voltage = state->has_voltage[k] ? &state->voltage[k] : NULL;
                const int64_t corrected = hv_correct(branch, &calibration->branch[k], code, voltage);
                if (corrected != code) {
                    write_code(&branch->current.place, payload, corrected);
                    result = HV_CHANGED;
                }
            }
        }
        if ((result == HV_CHANGED) && (message->profile != HV_UNPROTECTED)) {
            payload[message->offset] = crc_of(message, payload, length);
        }
    } else {
        /* passed on as it is */
    }
    return result;
}

hv_result_t hv_forward(const hv_layout_t *layout, const hv_calibration_t *calibration, hv_state_t *state,
                       uint32_t identifier, uint8_t *payload, size_t length)
{
    hv_result_t result = HV_SAME;
    for (size_t k = 0U; k < layout->message_count; k++) {
        if (layout->messages[k].identifier == identifier) {
            result = forward(layout, calibration, state, k, payload, length);
        }
    }
    return result;
}

static void forget(hv_received_t *received)
{
    received->usable = 0U;
    received->corrupt = 0U;
    received->expected = ANY;
}

void hv_start(hv_state_t *state)
{
    for (size_t k = 0U; k < HV_MESSAGES; k++) {
        forget(&state->message[k]);
        state->message[k].state = INIT;
    }
    for (size_t k = 0U; k < HV_BRANCHES; k++) {
        state->has_voltage[k] = false;
    }
}

void hv_restart(const hv_layout_t *layout, hv_state_t *state, uint32_t identifier)
{
    for (size_t k = 0U; k < layout->message_count; k++) {
        if (layout->messages[k].identifier == identifier) {
            hv_received_t *const received = &state->message[k];
            forget(received);
            received->state = (received->state == VALID) ? INVALID : received->state;
            for (size_t b = 0U; b < layout->branch_count; b++) {
                if (layout->branches[b].voltage_message == k) {
                    state->has_voltage[b] = false;
                }
            }
        }
    }
}
