// Our own threads. libgomp hangs in a forked child, so workers here know of forks.
//
// Work is handed out in pieces whose results never depend on who does them: every kernel gives
// the same bits for any number of threads.
#pragma once

#include <cstdint>
#include <functional>

#include "buffer.h"

namespace splatseg {

// Number of threads kernels use; at least 1.
int threads();
void set_threads(int count);

// Calls work(thread) once on each of threads() threads and waits. A call from inside another,
// or while another caller holds the pool, runs work(0 .. threads - 1) one after the other.
void run_on_threads(int count, const std::function<void(int)>& work);

// Calls work(begin, end) over [0, count) in pieces of at most `grain`, in any order.
void parallel_for(int64_t count, int64_t grain, const std::function<void(int64_t, int64_t)>& work);

// The same with the number of the thread, for scratch memory.
void parallel_for_thread(int64_t count, int64_t grain,
                         const std::function<void(int, int64_t, int64_t)>& work);

// For items 0, 1, ... count - 1: make(thread, item, buffer) in any order on all threads, and
// add(item, buffer) in the order of items, one at a time, as soon as their turn comes. Who is done
// with an item whose turn has not come goes on with the next one.
void in_order(int64_t count, const std::function<void(int, int64_t, Buffer<float>&)>& make,
              const std::function<void(int64_t, const Buffer<float>&)>& add);

}  // namespace splatseg
