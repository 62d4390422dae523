/* A gateway between two SocketCAN interfaces that does with the bench's frames what the node does. */
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

int main(int count, char **names)
{
    int in = count == 3 ? open_bus(names[1]) : -1, out = in < 0 ? -1 : open_bus(names[2]);
    struct can_frame frame;
    hv_state_t state;
    if (out < 0)
        return 1;
    hv_start(&state);
    while (read(in, &frame, sizeof frame) == sizeof frame) {
        if (hv_forward(&hv_layout, &hv_calibration, &state, frame.can_id, frame.data, frame.can_dlc) == HV_HELD_BACK)
            continue;
        while (write(out, &frame, sizeof frame) != sizeof frame)
            usleep(100);
    }
    return 0;
}
