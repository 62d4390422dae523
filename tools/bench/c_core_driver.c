/* Runs the C core, to be compared with the node: corrects the codes on its command line, or else the records of frames
 * on standard input, and writes the results to standard output. */
#include "hv_correction.h"
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

int main(int count, char **words)
{
    uint8_t record[70]; /* identifier, little-endian; length, or 255: silence; result; payload */
    hv_state_t state;

    if (count == 5) { /* arguments: number of the branch, first and last code, voltage code or "-" */
        const size_t k = strtoul(words[1], NULL, 10);
        const int64_t last = strtoll(words[3], NULL, 10), voltage = strtoll(words[4], NULL, 10);
        for (int64_t code = strtoll(words[2], NULL, 10); code <= last; code++) {
            const int64_t *known = strcmp(words[4], "-") == 0 ? NULL : &voltage;
            const int64_t result = hv_correct(&hv_layout.branches[k], &hv_calibration.branch[k], code, known);
            fwrite(&result, sizeof result, 1, stdout);
        }
        return 0;
    }
    hv_start(&state);
    while (fread(record, sizeof record, 1, stdin) == 1) {
        const uint32_t identifier = record[0] | (uint32_t)record[1] << 8 | (uint32_t)record[2] << 16 | (uint32_t)record[3] << 24;
        if (record[4] == 255)
            for (size_t k = 0; k < hv_layout.message_count; k++)
                hv_restart(&hv_layout, &state, hv_layout.messages[k].identifier);
        else
            record[5] = (uint8_t)hv_forward(&hv_layout, &hv_calibration, &state, identifier, record + 6, record[4]);
        fwrite(record, sizeof record, 1, stdout);
    }
    return 0;
}
