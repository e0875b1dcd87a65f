/* The bare poller in C: wait for the slot, ask, take the answer, count the slots that were met. */
#include <stdint.h>
#include <sys/socket.h>
#include <time.h>

static int64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * 1000000000LL + now.tv_nsec;
}

static void wait_until(int64_t due, int64_t spin_ns)
{
    int64_t wake = due - spin_ns;
    struct timespec at = {wake / 1000000000LL, wake % 1000000000LL};
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, 0);
    while (now_ns() < due)
        ;
}

/* Slots met out of `slots`, or -1 if the connection broke. */
int64_t poll_slots(int fd, const uint8_t *request, int64_t request_size, int64_t answer_size,
                   int64_t slots, int64_t slot_ns, int64_t spin_ns)
{
    uint8_t answer[512];
    int64_t start = now_ns(), met = 0;
    for (int64_t slot = 0; slot < slots;) {
        wait_until(start + slot * slot_ns, spin_ns);
        if (send(fd, request, request_size, 0) != request_size ||
            recv(fd, answer, answer_size, MSG_WAITALL) != answer_size)
            return -1;
        met++;
        int64_t now = (now_ns() - start) / slot_ns;
        slot = slot + 1 > now ? slot + 1 : now;
    }
    return met;
}
