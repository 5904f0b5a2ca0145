// SPDX-License-Identifier: MIT OR Apache-2.0
#ifndef CLOCK_HPP_
#define CLOCK_HPP_

#include <time.h>

#include <cstdint>

// The machine's monotonic clock in nanoseconds: the same one in all processes, also of other network namespaces.
inline uint64_t now_ns()
{
  timespec time{};
  clock_gettime(CLOCK_MONOTONIC, &time);
  return static_cast<uint64_t>(time.tv_sec) * 1'000'000'000 + static_cast<uint64_t>(time.tv_nsec);
}

// CPU time of this process, all threads, in nanoseconds.
inline uint64_t cpu_ns()
{
  timespec time{};
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &time);
  return static_cast<uint64_t>(time.tv_sec) * 1'000'000'000 + static_cast<uint64_t>(time.tv_nsec);
}

#endif  // CLOCK_HPP_
