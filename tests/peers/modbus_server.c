/* A Modbus TCP server of other make: the trace ring and plain registers of a known signal.
 *
 * usage: modbus_server PORT (0 takes any free one); says "listening on HOST:PORT"
 * build: cc -O2 -pthread modbus_server.c $(pkg-config --cflags --libs libmodbus)
 */
#include <arpa/inet.h>
#include <errno.h>
#include <modbus.h>
#include <pthread.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/select.h>
#include <time.h>
#include <unistd.h>

enum { DEPTH = 4096, HEADER = 100, RING = 1000, RECORD = 4 };

static modbus_mapping_t *map;
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;

static void put(uint16_t *at, uint64_t value, int words)
{
    for (int word = 0; word < words; word++) /* high word first */
        at[word] = (uint16_t)(value >> 16 * (words - 1 - word));
}

static uint32_t bits(float value)
{
    uint32_t raw;
    memcpy(&raw, &value, sizeof raw);
    return raw;
}

static int64_t now_ns(clockid_t clock)
{
    struct timespec now;
    clock_gettime(clock, &now);
    return now.tv_sec * 1000000000LL + now.tv_nsec;
}

/* One scan: its record, the plain registers, and last of all the header that announces it. */
static void scan(uint32_t number, int64_t time_ns)
{
    static const uint16_t commands[] = {0, 1, 0, 2};
    uint16_t status = commands[number >> 8 & 3];
    float pressure = 200.0f + (number % 4096) * 0.25f; /* mbar, says which scan it is */
    uint16_t *record = map->tab_registers + RING + RECORD * (number % DEPTH);
    record[0] = (uint16_t)number;
    record[1] = status;
    put(record + 2, bits(pressure), 2);
    map->tab_bits[0] = status & 1;
    map->tab_bits[1] = status >> 1;
    uint16_t *plain = map->tab_input_registers;
    plain[0] = (uint16_t)(pressure * 10);
    put(plain + 1, bits(pressure), 2);
    plain[3] = 5000;
    plain[4] = status;
    put(plain + 5, number, 2);
    put(map->tab_registers + HEADER, number, 2);
    put(map->tab_registers + HEADER + 2, (uint64_t)time_ns, 4);
}

static int64_t first, began; /* of scan 0: monotonic, and as the header tells it */

static void *task(void *unused)
{
    for (uint32_t number = 1;; number++) {
        int64_t due = first + number * 1000000LL;
        struct timespec at = {due / 1000000000LL, due % 1000000000LL};
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, NULL) == EINTR)
            ;
        pthread_mutex_lock(&lock);
        scan(number, began + number * 1000000LL);
        pthread_mutex_unlock(&lock);
    }
    return unused;
}

static void constants(void)
{
    uint16_t *test = map->tab_registers, *header = map->tab_registers + HEADER;
    test[0] = 0x1234;
    test[1] = (uint16_t)-12345;
    put(test + 2, 0x12345678, 2);
    put(test + 4, bits(123.456f), 2);
    header[6] = (uint16_t)getpid(); /* boot */
    header[7] = 1000;               /* µs */
    header[8] = DEPTH;
    header[9] = RECORD;
    header[10] = 5000; /* supply, mbar gauge */
}

/* Answer whoever has something to ask, for ever. */
static void serve(modbus_t *context, int listener)
{
    uint8_t query[MODBUS_TCP_MAX_ADU_LENGTH];
    fd_set open, ready;
    FD_ZERO(&open);
    FD_SET(listener, &open);
    for (;;) {
        ready = open;
        if (select(FD_SETSIZE, &ready, NULL, NULL, NULL) < 0)
            return;
        for (int one = 0; one < FD_SETSIZE; one++) {
            if (!FD_ISSET(one, &ready))
                continue;
            if (one == listener) {
                int client = modbus_tcp_accept(context, &listener);
                if (client >= 0)
                    FD_SET(client, &open);
                continue;
            }
            modbus_set_socket(context, one);
            int size = modbus_receive(context, query);
            if (size < 0) {
                close(one);
                FD_CLR(one, &open);
            } else if (size > 0) {
                pthread_mutex_lock(&lock);
                modbus_reply(context, query, size, map);
                pthread_mutex_unlock(&lock);
            }
        }
    }
}

int main(int count, char **arguments)
{
    modbus_t *context = modbus_new_tcp("127.0.0.1", count > 1 ? atoi(arguments[1]) : 0);
    map = modbus_mapping_new(2, 0, RING + RECORD * DEPTH, 7);
    int listener = context && map ? modbus_tcp_listen(context, 8) : -1;
    struct sockaddr_in address;
    socklen_t size = sizeof address;
    pthread_t thread;
    if (listener < 0 || getsockname(listener, (struct sockaddr *)&address, &size) < 0) {
        fprintf(stderr, "%s\n", modbus_strerror(errno));
        return 1;
    }
    constants();
    first = now_ns(CLOCK_MONOTONIC), began = now_ns(CLOCK_REALTIME);
    scan(0, began); /* whoever asks at once finds a ring that runs */
    if (pthread_create(&thread, NULL, task, NULL) != 0)
        return 1;
    printf("listening on 127.0.0.1:%d\n", ntohs(address.sin_port));
    fflush(stdout);
    serve(context, listener);
    return 1;
}
