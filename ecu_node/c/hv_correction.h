/* Correction of high-voltage currents in CAN frames, for control units: the same bits as the Python node as a gateway.
 *
 * The code is fixed. What differs between vehicle types is a const hv_layout_t, what differs between vehicles a const
 * hv_calibration_t, which is flashed; 'calibrator export' writes both. C99; no library, allocation, floating point,
 * recursion or global state. A calibration for another layout, or erased memory, passes every frame through.
 */
#ifndef HV_CORRECTION_H
#define HV_CORRECTION_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define HV_BRANCHES 16U /* most branches and messages that a layout can have */
#define HV_MESSAGES 32U

/* Flashed data. A corrected code is (code * gain + voltage_code * voltage_gain + fraction) / 2^58 + bias, rounded
 * down, and then clamped; half a code, which rounds to the nearest one, is part of bias and fraction. */
typedef struct {
    int64_t gain;         /* [2^-58] */
    int64_t voltage_gain; /* for a power: [2^-58 codes of the power per code of the voltage]; else 0 */
    int64_t bias;         /* [code] */
    uint64_t fraction;    /* [2^-58 codes], below 2^58 */
    uint64_t applied;     /* 1: corrected; all else: passed through */
} hv_values_t;

typedef struct {
    uint64_t layout;        /* digest of the layout; if it is not that of hv_layout_t, nothing is corrected */
    uint64_t parameter_set; /* number of the parameter set */
    hv_values_t branch[HV_BRANCHES];
} hv_calibration_t;

/* Compiled data: where signals stand and which of their codes are values, from DBC and layout. */
typedef struct {
    uint8_t byte;  /* byte that holds the least significant bit */
    uint8_t shift; /* bits below the signal in that byte, 0 to 7 */
    uint8_t bits;  /* 1 to 64 */
    bool is_big;   /* byte order: big-endian */
    bool is_signed;
} hv_place_t;

typedef struct { /* a signal is in a frame only if this multiplexer has one of these codes */
    hv_place_t place;
    const int64_t *codes;
    size_t count;
} hv_selector_t;

typedef struct {
    hv_place_t place;
    const hv_selector_t *selectors;
    size_t selector_count;
    int64_t lowest; /* codes outside lowest to highest, and named ones, are no values */
    int64_t highest;
    const int64_t *named;
    size_t named_count;
} hv_signal_t;

typedef struct {
    size_t message; /* number of the message that carries the current, or the power */
    hv_signal_t current;
    size_t voltage_message;
    const hv_signal_t *voltage; /* NULL where the branch is a current */
    int64_t lowest;             /* results are clamped to these */
    int64_t highest;
} hv_branch_t;

typedef enum { /* AUTOSAR end-to-end protection of a message: profiles 1A, 1B, 1 with the low byte only, 1C, 2 */
    HV_UNPROTECTED,
    HV_P01_BOTH,
    HV_P01_ALTERNATING,
    HV_P01_LOW,
    HV_P01_NIBBLE,
    HV_P02
} hv_profile_t;

typedef struct { /* condition on the last frames of a message under which it is VALID, as in the layout */
    uint8_t frames;    /* how many are looked at, 1 to 64; 0 in a message without a voltage, whose state is not kept */
    uint8_t min_ok;    /* fewest of them that must be usable */
    uint8_t max_error; /* most of them that may be corrupt */
} hv_window_t;

typedef struct {
    uint32_t identifier; /* bit 31 is set in 29-bit identifiers */
    hv_profile_t profile;
    uint8_t offset;        /* first byte of the header */
    uint8_t max_step;      /* largest step of the counter that is used */
    bool has_branches;
    uint8_t data_id[16];   /* profile 1: low byte, high byte; profile 2: the list */
    hv_window_t window[3]; /* to become VALID at the start, to stay so, and to become so again when INVALID */
} hv_message_t;

typedef struct {
    uint64_t digest;
    const hv_message_t *messages;
    size_t message_count;
    const hv_branch_t *branches;
    size_t branch_count;
} hv_layout_t;

typedef struct {
    uint64_t usable;  /* one bit for each of the last 64 frames; bit 0 is the last one */
    uint64_t corrupt;
    uint8_t expected; /* counter of the next frame */
    uint8_t state;    /* of AUTOSAR's E2E state machine */
} hv_received_t;

typedef struct { /* what is remembered from frame to frame; one for each layout, in RAM */
    hv_received_t message[HV_MESSAGES];
    bool has_voltage[HV_BRANCHES];
    int64_t voltage[HV_BRANCHES];
} hv_state_t;

typedef enum { HV_SAME, HV_CHANGED, HV_HELD_BACK } hv_result_t;

/* Defined in the file that 'calibrator export' writes. */
extern const hv_layout_t hv_layout;
extern const hv_calibration_t hv_calibration;

/* Forget all that was received: at start. */
void hv_start(hv_state_t *state);

/* Forget counter and voltage of one message: when it has been silent for longer than its time-out, each one after the
 * bus has slept. If the message was VALID it becomes INVALID, and its voltage is used again when it has recovered. */
void hv_restart(const hv_layout_t *layout, hv_state_t *state, uint32_t identifier);

/* Take a frame from one bus: check it, correct its currents in place, protect it anew with the counter it came with.
 * The voltage of a message that is INVALID, in which too many frames fail their check, is not used.
 * HV_SAME and HV_CHANGED: send the payload on; HV_HELD_BACK: do not. Other identifiers are HV_SAME. */
hv_result_t hv_forward(const hv_layout_t *layout, const hv_calibration_t *calibration, hv_state_t *state,
                       uint32_t identifier, uint8_t *payload, size_t length);

/* Correct one code of a branch; a code that is no value, or whose voltage is not known (NULL), comes back as it is. */
int64_t hv_correct(const hv_branch_t *branch, const hv_values_t *values, int64_t code, const int64_t *voltage_code);

#endif
