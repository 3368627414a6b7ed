#include "core/parallel.h"

#include <pthread.h>

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <mutex>
#include <system_error>
#include <thread>
#include <vector>

namespace spslam {
namespace {

// One loop at a time runs on the workers; a loop started inside another one, or beside it from a second thread, runs on
// its own caller.
//
// Chunks are claimed from one counter that carries the loop's generation, and the caller waits for chunks, not for
// workers: a worker that wakes late, because other processes have the cores, finds the generation over and holds nobody
// up.
class ThreadPool {
 public:
  explicit ThreadPool(int count) : count_(count) {}

  void resize(int count) {
    std::lock_guard<std::mutex> running(loop_mutex_);
    stop();
    count_ = count < 1 ? 1 : count;
  }

  int size() const { return count_; }

  void run(std::int64_t chunks, detail::ChunkFunction function, void* context) {
    if (chunks <= 0) return;
    if (chunks == 1 || chunks > kChunkMask || count_ == 1 || inside_loop_ || !loop_mutex_.try_lock()) {
      for (std::int64_t chunk = 0; chunk < chunks; ++chunk) function(context, chunk);
      return;
    }
    std::lock_guard<std::mutex> running(loop_mutex_, std::adopt_lock);
    start();
    Loop loop{0, chunks, function, context};
    {
      std::lock_guard<std::mutex> lock(mutex_);
      loop.generation = loop_.generation + 1;
      loop_ = loop;
      done_.store(0, std::memory_order_relaxed);
      next_.store(static_cast<std::uint64_t>(loop.generation) << kChunkBits, std::memory_order_release);
    }
    wake_.notify_all();
    take_chunks(loop);
    wait_for_chunks(chunks);
  }

 private:
  struct Loop {
    std::uint32_t generation;
    std::int64_t chunks;
    detail::ChunkFunction function;
    void* context;
  };

  static constexpr int kChunkBits = 32;
  static constexpr std::int64_t kChunkMask = (std::int64_t{1} << kChunkBits) - 1;
  // How long a thread spins before it sleeps: kernels follow each other within microseconds.
  static constexpr int kSpins = 4000;

  void start() {
    if (!workers_.empty()) return;
    stopping_ = false;
    const std::uint32_t seen = loop_.generation;
    try {
      for (int i = 1; i < count_; ++i) workers_.emplace_back([this, seen] { work(seen); });
    } catch (const std::system_error&) {
      // The system gives no more threads: the loop runs on those there are, the caller at least.
    }
  }

  void stop() {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      stopping_ = true;
      loop_ = Loop{loop_.generation + 1, 0, nullptr, nullptr};
      next_.store(static_cast<std::uint64_t>(loop_.generation) << kChunkBits, std::memory_order_release);
    }
    wake_.notify_all();
    for (std::thread& worker : workers_) worker.join();
    workers_.clear();
  }

  void work(std::uint32_t seen) {
    inside_loop_ = true;
    while (true) {
      for (int spin = 0; spin < kSpins && current_generation() == seen; ++spin) pause();
      Loop loop;
      {
        std::unique_lock<std::mutex> lock(mutex_);
        wait(wake_, lock, [&] { return loop_.generation != seen; });
        if (stopping_) return;
        loop = loop_;
      }
      seen = loop.generation;
      take_chunks(loop);
    }
  }

  void take_chunks(const Loop& loop) {
    const bool nested = inside_loop_;
    inside_loop_ = true;
    std::uint64_t ticket = next_.load(std::memory_order_acquire);
    while (true) {
      const std::int64_t chunk = static_cast<std::int64_t>(ticket) & kChunkMask;
      if (static_cast<std::uint32_t>(ticket >> kChunkBits) != loop.generation || chunk >= loop.chunks) break;
      if (!next_.compare_exchange_weak(ticket, ticket + 1, std::memory_order_acq_rel)) continue;
      loop.function(loop.context, chunk);
      if (done_.fetch_add(1, std::memory_order_acq_rel) + 1 == loop.chunks) {
        std::lock_guard<std::mutex> lock(mutex_);
        finished_.notify_one();
      }
      ticket = next_.load(std::memory_order_acquire);
    }
    inside_loop_ = nested;
  }

  void wait_for_chunks(std::int64_t chunks) {
    for (int spin = 0; spin < kSpins && done_.load(std::memory_order_acquire) < chunks; ++spin) pause();
    if (done_.load(std::memory_order_acquire) == chunks) return;
    std::unique_lock<std::mutex> lock(mutex_);
    wait(finished_, lock, [&] { return done_.load(std::memory_order_acquire) == chunks; });
  }

  // Without a time limit the wait is a function of libstdc++ 12: a wheel built there would not load on older systems.
  template <class Condition>
  static void wait(std::condition_variable& event, std::unique_lock<std::mutex>& lock, const Condition& condition) {
    while (!event.wait_for(lock, std::chrono::hours(1), condition)) {}
  }

  std::uint32_t current_generation() const {
    return static_cast<std::uint32_t>(next_.load(std::memory_order_acquire) >> kChunkBits);
  }

  static void pause() {
#if defined(__x86_64__)
    __builtin_ia32_pause();
#endif
  }

  std::atomic<int> count_;
  std::vector<std::thread> workers_;
  std::mutex loop_mutex_, mutex_;
  std::condition_variable wake_, finished_;
  Loop loop_{0, 0, nullptr, nullptr};
  std::atomic<std::uint64_t> next_{0};  // generation << 32 | next chunk
  std::atomic<std::int64_t> done_{0};
  bool stopping_ = false;
  static thread_local bool inside_loop_;
};

thread_local bool ThreadPool::inside_loop_ = false;

int default_count() {
  const unsigned cores = std::thread::hardware_concurrency();
  return cores ? static_cast<int>(cores) : 1;
}

// Made at the first use. Without the lock of a static local variable, which another thread may hold at a fork. Never
// destroyed: joining threads while the process's other static objects go away is a known way to hang at exit.
std::atomic<ThreadPool*> current_pool{nullptr};

ThreadPool& pool() {
  ThreadPool* existing = current_pool.load(std::memory_order_acquire);
  if (existing) return *existing;
  ThreadPool* const made = new ThreadPool(default_count());
  if (current_pool.compare_exchange_strong(existing, made, std::memory_order_acq_rel)) return *made;
  delete made;
  return *existing;
}

// A forked child has a copy of the pool but none of its threads, and its locks as they were at that moment, held by
// whoever ran a loop. So the child gets a pool of its own and never touches the copy, which is not freed.
void renew_pool_in_child() {
  const ThreadPool* parents = current_pool.load(std::memory_order_acquire);
  if (parents) current_pool.store(new ThreadPool(parents->size()), std::memory_order_release);
}

[[maybe_unused]] const int fork_handler = pthread_atfork(nullptr, nullptr, renew_pool_in_child);

}  // namespace

void set_num_threads(int count) {
  pool().resize(count);
}
int get_num_threads() {
  return pool().size();
}

namespace detail {
void run_chunks(std::int64_t chunks, ChunkFunction function, void* context) {
  pool().run(chunks, function, context);
}
}  // namespace detail

}  // namespace spslam
