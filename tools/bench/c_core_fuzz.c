/* libFuzzer: any calibration, any frames. Each payload has a block of memory of its own, whose ends ASan watches. */
#include "hv_correction.h"
#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    hv_calibration_t calibration = hv_calibration;
    hv_state_t state;
    hv_start(&state);
    if (size >= sizeof calibration && (data[size - 1] & 1)) { /* else: as it was exported */
        memcpy(&calibration, data, sizeof calibration);
        data += sizeof calibration;
        size -= sizeof calibration;
        if (size && (data[size - 1] & 2))
            calibration.layout = hv_layout.digest;
    }
    while (size > 2) {
        const hv_message_t *message = &hv_layout.messages[data[0] % hv_layout.message_count];
        size_t length = data[1] % 65;
        if (length > size - 2)
            length = size - 2;
        uint8_t *payload = malloc(length ? length : 1);
        memcpy(payload, data + 2, length);
        if (data[0] & 0x80)
            hv_restart(&hv_layout, &state, message->identifier);
        hv_forward(&hv_layout, &calibration, &state, message->identifier, payload, length);
        free(payload);
        data += 2 + length;
        size -= 2 + length;
    }
    return 0;
}
