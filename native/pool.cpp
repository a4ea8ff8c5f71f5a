#include "pool.h"

#include <pthread.h>
#if defined(__linux__)
#include <sched.h>
#endif

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdlib>
#include <memory>
#include <mutex>
#include <thread>
#include <utility>
#include <vector>

namespace splatseg {
namespace {

int default_threads() {
  if (const char* text = std::getenv("SPLATSEG_THREADS")) {
    int count = std::atoi(text);
    if (count > 0) return count;
  }
#if defined(__linux__)  // elsewhere a thread is not bound to some of the cores
  cpu_set_t set;
  CPU_ZERO(&set);
  if (pthread_getaffinity_np(pthread_self(), sizeof set, &set) == 0) return std::max(1, CPU_COUNT(&set));
#endif
  return static_cast<int>(std::max(1u, std::thread::hardware_concurrency()));
}

// Sleeping workers, woken by a new generation of work.
class Workers {
 public:
  explicit Workers(int count) {
    for (int i = 1; i <= count; ++i) threads_.emplace_back([this, i] { loop(i); });
  }
  ~Workers() {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      stop_ = true;
    }
    wake_.notify_all();
    for (auto& thread : threads_) thread.join();
  }
  int size() const { return static_cast<int>(threads_.size()); }

  void run(int count, const std::function<void(int)>& work) {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      work_ = &work;
      wanted_ = count;
      left_ = size();
      ++generation_;
    }
    wake_.notify_all();
    work(0);
    std::unique_lock<std::mutex> lock(mutex_);
    done_.wait(lock, [this] { return left_ == 0; });
  }

 private:
  void loop(int index) {
    uint64_t seen = 0;
    for (;;) {
      const std::function<void(int)>* work = nullptr;
      {
        std::unique_lock<std::mutex> lock(mutex_);
        wake_.wait(lock, [&] { return stop_ || generation_ != seen; });
        if (stop_) return;
        seen = generation_;
        if (index < wanted_) work = work_;
      }
      if (work) (*work)(index);
      std::lock_guard<std::mutex> lock(mutex_);
      if (--left_ == 0) done_.notify_one();
    }
  }

  std::vector<std::thread> threads_;
  std::mutex mutex_;
  std::condition_variable wake_, done_;
  const std::function<void(int)>* work_ = nullptr;
  uint64_t generation_ = 0;
  int wanted_ = 0, left_ = 0;
  bool stop_ = false;
};

std::atomic<int> wanted_threads{0};
std::mutex* busy = new std::mutex;  // replaced, not unlocked, in a forked child
Workers* workers = nullptr;

// A forked child has none of the parent's threads; the old objects cannot be destroyed there.
void after_fork_in_child() {
  busy = new std::mutex;
  workers = nullptr;
}

// Joins the workers when the library is unloaded in the process that started them.
struct AtExit {
  AtExit() { pthread_atfork(nullptr, nullptr, after_fork_in_child); }
  ~AtExit() { delete std::exchange(workers, nullptr); }
} at_exit;

}  // namespace

int threads() {
  int count = wanted_threads.load();
  if (count == 0) wanted_threads = count = default_threads();
  return count;
}

void set_threads(int count) { wanted_threads = std::max(1, count); }

void run_on_threads(int count, const std::function<void(int)>& work) {
  if (count > 1 && busy->try_lock()) {
    std::lock_guard<std::mutex> lock(*busy, std::adopt_lock);
    if (!workers || workers->size() < count - 1) {
      delete workers;
      workers = new Workers(count - 1);
    }
    workers->run(count, work);
    return;
  }
  for (int i = 0; i < count; ++i) work(i);
}

void parallel_for_thread(int64_t count, int64_t grain,
                         const std::function<void(int, int64_t, int64_t)>& work) {
  grain = std::max<int64_t>(1, grain);
  int64_t pieces = (count + grain - 1) / grain;
  int used = static_cast<int>(std::min<int64_t>(threads(), pieces));
  if (used <= 1) {
    for (int64_t begin = 0; begin < count; begin += grain)
      work(0, begin, std::min(begin + grain, count));
    return;
  }
  std::atomic<int64_t> next{0};
  run_on_threads(used, [&](int thread) {
    for (int64_t piece; (piece = next.fetch_add(1)) < pieces;)
      work(thread, piece * grain, std::min((piece + 1) * grain, count));
  });
}

void in_order(int64_t count, const std::function<void(int, int64_t, Buffer<float>&)>& make,
              const std::function<void(int64_t, const Buffer<float>&)>& add) {
  constexpr int kAhead = 2;  // items a thread may be ahead: few, so that their rows stay in cache
  const int used = static_cast<int>(std::min<int64_t>(threads(), count));
  const int64_t room = static_cast<int64_t>(std::max(used, 1)) * kAhead;
  // Item i lives in slot i % room, which is free once item i - room was added.
  std::vector<Buffer<float>> slots(static_cast<size_t>(room));
  std::vector<char> ready(static_cast<size_t>(room), 0);
  std::mutex mutex;
  std::condition_variable moved;
  int64_t next = 0, turn = 0;
  bool adding = false;
  run_on_threads(used, [&](int thread) {
    std::unique_lock<std::mutex> lock(mutex);
    while (next < count) {
      const int64_t item = next;
      if (item >= turn + room) {  // the item whose turn it is is being made or added by another
        moved.wait(lock, [&] { return next >= count || next < turn + room; });
        continue;
      }
      ++next;
      lock.unlock();
      make(thread, item, slots[static_cast<size_t>(item % room)]);
      lock.lock();
      ready[static_cast<size_t>(item % room)] = 1;
      if (adding) continue;
      adding = true;
      while (turn < count && ready[static_cast<size_t>(turn % room)]) {
        const size_t slot = static_cast<size_t>(turn % room);
        lock.unlock();
        add(turn, slots[slot]);
        lock.lock();
        ready[slot] = 0;
        ++turn;
        moved.notify_all();
      }
      adding = false;
    }
  });
}

void parallel_for(int64_t count, int64_t grain, const std::function<void(int64_t, int64_t)>& work) {
  parallel_for_thread(count, grain, [&](int, int64_t begin, int64_t end) { work(begin, end); });
}

}  // namespace splatseg
