/* The plainest periodic loop there is: sleep to absolute deadlines 1 ms apart, note how late each wake-up is.

   usage: realtime SECONDS CPU PRIORITY FILE     PRIORITY 0 = the ordinary scheduler, 1..99 = SCHED_FIFO
   FILE gets the lateness of every tick in ns, int64. */
#define _GNU_SOURCE
#include <sched.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <time.h>

static int64_t now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

int main(int argc, char **argv)
{
    if (argc != 5) return 2;
    int ticks = (int)(atof(argv[1]) * 1000), priority = atoi(argv[3]);
    int64_t *late = malloc(sizeof *late * (size_t)ticks);
    cpu_set_t cpus;
    CPU_ZERO(&cpus);
    CPU_SET(atoi(argv[2]), &cpus);
    if (!late || sched_setaffinity(0, sizeof cpus, &cpus)) return 3;
    struct sched_param p = {.sched_priority = priority};
    if (priority && sched_setscheduler(0, SCHED_FIFO, &p)) return 4;
    prctl(PR_SET_TIMERSLACK, 1UL, 0UL, 0UL, 0UL);
    mlockall(MCL_CURRENT | MCL_FUTURE);
    for (int k = 0; k < ticks; k++) late[k] = 0; /* touch the pages */
    int64_t deadline = now() + 1000000;
    for (int k = 0; k < ticks; k++, deadline += 1000000) {
        struct timespec t = {deadline / 1000000000, deadline % 1000000000};
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL)) { }
        late[k] = now() - deadline;
    }
    FILE *f = fopen(argv[4], "wb");
    if (!f || fwrite(late, sizeof *late, (size_t)ticks, f) != (size_t)ticks || fclose(f)) return 5;
    return 0;
}
