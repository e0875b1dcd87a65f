/* The trace ring fetched in C: by a bare socket, or by libmodbus (-DLIBMODBUS), nothing else. */
#include <stdint.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#ifdef LIBMODBUS
#include <modbus.h>
#endif

enum { HEADER = 100, HEADER_WORDS = 12, RING = 1000, DEPTH = 4096, RECORD = 4, AT_ONCE = 31 };

#ifdef LIBMODBUS
typedef modbus_t *Link;

static int words(Link link, int address, int count, uint16_t *into)
{
    return modbus_read_registers(link, address, count, into) == count;
}

static int64_t newest(Link link)
{
    uint16_t header[HEADER_WORDS];
    if (!words(link, HEADER, HEADER_WORDS, header))
        return -1;
    return (int64_t)header[0] << 16 | header[1];
}
#else
typedef int Link;

static int words(Link link, int address, int count, uint16_t *into)
{
    uint8_t request[12] = {0, 1, 0, 0, 0, 6, 1, 3, address >> 8, address, 0, count};
    uint8_t answer[9 + 2 * 125];
    int size = 9 + 2 * count;
    if (send(link, request, 12, 0) != 12 || recv(link, answer, size, MSG_WAITALL) != size)
        return 0;
    memcpy(into, answer + 9, 2 * count); /* as they come */
    return answer[7] == 3;
}

static int64_t newest(Link link)
{
    uint16_t header[HEADER_WORDS];
    const uint8_t *bytes = (const uint8_t *)header;
    if (!words(link, HEADER, HEADER_WORDS, header))
        return -1;
    return (int64_t)bytes[0] << 24 | bytes[1] << 16 | bytes[2] << 8 | bytes[3];
}
#endif

/* Records fetched in so many turns, one each `interval_ns`; -1 if the connection broke. */
static int64_t fetched(Link link, int64_t turns, int64_t interval_ns)
{
    uint16_t records[RECORD * AT_ONCE];
    int64_t seen = newest(link), first = seen;
    for (int64_t turn = 0; turn < turns && seen >= 0; turn++) {
        nanosleep(&(struct timespec){0, interval_ns}, 0);
        int64_t now = newest(link);
        while (seen < now) {
            int64_t at = (seen + 1) % DEPTH, count = now - seen;
            count = count < AT_ONCE ? count : AT_ONCE;
            count = count < DEPTH - at ? count : DEPTH - at;
            if (!words(link, RING + RECORD * at, RECORD * count, records))
                return -1;
            seen += count;
        }
        seen = now < 0 ? -1 : seen;
    }
    return seen < 0 ? -1 : seen - first;
}

int64_t fetch(int port, int64_t turns, int64_t interval_ns, int connection)
{
#ifdef LIBMODBUS
    (void)connection; /* it makes its own */
    modbus_t *link = modbus_new_tcp("127.0.0.1", port);
    int64_t records = -1;
    if (link != 0 && modbus_set_slave(link, 1) == 0 && modbus_connect(link) == 0)
        records = fetched(link, turns, interval_ns);
    modbus_close(link);
    modbus_free(link);
    return records;
#else
    (void)port;
    return fetched(connection, turns, interval_ns);
#endif
}
