"""A gateway in C that does with the bench's frames what the node does: check, correct, seal.

The arithmetic is that of ``calibrator export --format c99``; CRC and counter of E2E profile 1 are beside it.
"""

import shutil
import subprocess
from pathlib import Path

from bench.node_vehicle import BenchVehicle
from calibrator.export.c99 import c99_files
from calibrator.export.checked import Checked

__all__ = ["compile_gateway"]

_MAIN = """\
#include "hv_correction.h"
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <unistd.h>

static int open_bus(const char *name)
{
    struct ifreq interface;
    struct sockaddr_can address = {.can_family = AF_CAN};
    int bus = socket(PF_CAN, SOCK_RAW, CAN_RAW);
    strncpy(interface.ifr_name, name, IFNAMSIZ - 1);
    if (bus < 0 || ioctl(bus, SIOCGIFINDEX, &interface) < 0)
        return -1;
    address.can_ifindex = interface.ifr_ifindex;
    return bind(bus, (struct sockaddr *)&address, sizeof address) < 0 ? -1 : bus;
}

static uint8_t crc_of(const uint8_t *payload, size_t length) /* profile 1, both bytes of the data identifier */
{
    uint8_t bytes[10] = {HV_ID_Pair & 0xFF, HV_ID_Pair >> 8};
    uint8_t crc = 0;
    memcpy(bytes + 2, payload + 1, length - 1);
    for (size_t k = 0; k < length + 1; k++) {
        crc ^= bytes[k];
        for (int bit = 0; bit < 8; bit++)
            crc = (uint8_t)(crc & 0x80 ? crc << 1 ^ 0x1D : crc << 1);
    }
    return crc;
}

int main(int count, char **names)
{
    int in = count == 3 ? open_bus(names[1]) : -1, out = in < 0 ? -1 : open_bus(names[2]);
    int expected = -1;
    struct can_frame frame;
    if (out < 0)
        return 1;
    while (read(in, &frame, sizeof frame) == sizeof frame) {
        if (frame.can_id == HV_ID_Pair && frame.can_dlc == 8) {
            int counter = frame.data[1] & 15;
            int step = (counter - expected + 15) % 15;
            if (frame.data[0] != crc_of(frame.data, 8) || counter > 14 || (expected >= 0 && step > 2))
                continue;
            expected = (counter + 1) % 15;
            if (hv_rewrite_Pair(frame.data, 8))
                frame.data[0] = crc_of(frame.data, 8);
        }
        while (write(out, &frame, sizeof frame) != sizeof frame)
            usleep(100);
    }
    return 0;
}
"""


def compile_gateway(vehicle: BenchVehicle, folder: Path) -> Path:
    """Write and compile it.

    Parameters
    ----------
    vehicle : BenchVehicle
        Whose frames it corrects.
    folder : Path
        For everything.

    Returns
    -------
    Path
        The program: ``gateway CHANNEL_IN CHANNEL_OUT``.
    """
    checked = Checked(name="params", digest="0" * 64, parameters=vehicle.parameters, database=vehicle.database)
    for name, text in c99_files(checked).items():
        (folder / name).write_text(text)
    (folder / "gateway.c").write_text(_MAIN)
    sources = [folder / "gateway.c", folder / "hv_correction.c"]
    subprocess.run([shutil.which("gcc") or "gcc", "-O2", *sources, "-o", folder / "gateway"], check=True)
    return folder / "gateway"
