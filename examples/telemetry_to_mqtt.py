"""
Telemetry of the node to a broker
=================================

``ecu-node run ... --telemetry /dev/stdout | python telemetry_to_mqtt.py BROKER`` publishes the corrected currents
by MQTT (``pip install paho-mqtt``); a databroker of KUKSA takes the same names and values, see the end.
"""

import json
import sys


def currents(line: str) -> dict[str, float]:
    """Corrected currents in a line, by name; ``CurrentCurrent`` of VSS counts into the battery, the node out of it."""
    found = {name: branch["corrected_a"] for name, branch in json.loads(line)["branches"].items()}
    return {name: -a if name.endswith(".CurrentCurrent") else a for name, a in found.items() if a is not None}


if len(sys.argv) == 2:
    from paho.mqtt.publish import multiple

    for line in sys.stdin:
        multiple([(name.replace(".", "/"), a) for name, a in currents(line).items()], hostname=sys.argv[1])

# %%
# With KUKSA (``pip install kuksa-client``) the loop stands within ``with VSSClient("localhost", 55555) as client:`` and
# calls ``client.set_current_values({name: Datapoint(a) for name, a in currents(line).items()})``, for the branches that
# have a name of the VSS.
