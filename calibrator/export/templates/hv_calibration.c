{% macro place(at) %}
{[[ at.end - 1 if at.order == "big" else at.first ]]U, [[ at.shift ]]U, [[ at.length ]]U, [[ (at.order == "big") | tojson ]], [[ at.signed | tojson ]]}
{%- endmacro %}
{% macro int64s(numbers) %}
{% if numbers %}(const int64_t[]){[[ numbers | map("int64") | join(", ") ]]}{% else %}NULL{% endif %}, [[ numbers | length ]]U
{%- endmacro %}
{% macro signal(placed, codes) %}
{% set highest = [codes.highest, greatest] | min %}
{[[ place(placed.place) ]], {% if placed.above %}(const hv_selector_t[]){{% for above in placed.above -%}
{[[ place(above.place) ]], [[ int64s(above.codes | sort) ]]}[[ "" if loop.last else ", " ]]
{%- endfor %}}{% else %}NULL{% endif %}, [[ placed.above | length ]]U, [[ codes.lowest | int64 ]], [[ highest | int64 ]], [[ int64s(codes.named | select("ge", codes.lowest) | select("le", highest) | sort) ]]}
{%- endmacro %}
/* Written by 'calibrator export'; do not edit. Of hv_correction.h.
{% for key, value in provenance.items() %}
 * [[ key ]]: [[ value | comment ]]
{% endfor %}
 */
#include "hv_correction.h"

static const hv_message_t messages[] = {
{% for message, identifier, profile, offset, step, data_ids, has_branches, windows in messages %}
    {0x[[ "%X" | format(identifier) ]]U, [[ profile ]], [[ offset ]]U, [[ step ]]U, [[ has_branches | tojson ]], {[[ data_ids | map("string") | join("U, ") ]]U}, {{% for numbers in windows -%}
{[[ numbers | map("string") | join("U, ") ]]U}[[ "" if loop.last else ", " ]]
{%- endfor %}}}, /* [[ message | comment ]] */
{% endfor %}
};
static const hv_branch_t branches[] = {
{% for branch, (number, placed, codes), voltage, (lowest, highest) in branches %}
    {[[ number ]]U, [[ signal(placed, codes) ]],
     {%+ if voltage %}[[ voltage[0] ]]U, &(const hv_signal_t)[[ signal(voltage[1], voltage[2]) ]]{% else %}0U, NULL{% endif %}, [[ lowest | int64 ]], [[ [highest, greatest] | min | int64 ]]}, /* [[ branch.name | comment ]]: [[ branch.source | comment ]] */
{% endfor %}
};
const hv_layout_t hv_layout = {
    UINT64_C([[ digest ]]), messages, [[ messages | length ]]U, branches, [[ branches | length ]]U
};
const hv_calibration_t hv_calibration = {
    UINT64_C([[ digest ]]), UINT64_C([[ provenance.parameter_set ]]), {
{% for name, values in calibration %}
        {[[ values.gain | int64 ]], [[ values.voltage_gain | int64 ]], [[ values.bias | int64 ]], UINT64_C([[ values.fraction ]]), [[ values.applied ]]U}, /* [[ name | comment ]] */
{% endfor %}
    }
};
