#include "core/parallel.h"

#include <unistd.h>

#include <atomic>
#include <condition_variable>
#include <mutex>
#include <thread>
#include <vector>

namespace spslam {
namespace {

// One loop at a time runs on the workers; a loop started inside another one, or beside it from a second thread, runs on
// its own caller.
class ThreadPool {
 public:
  ~ThreadPool() { stop(); }

  void resize(int count) {
    std::lock_guard<std::mutex> running(loop_mutex_);
    stop();
    count_ = count < 1 ? 1 : count;
  }

  int size() const { return count_; }

  void run(std::int64_t chunks, detail::ChunkFunction function, void* context) {
    if (chunks <= 0) return;
    if (chunks == 1 || count_ == 1 || inside_loop_ || !loop_mutex_.try_lock()) {
      for (std::int64_t chunk = 0; chunk < chunks; ++chunk) function(context, chunk);
      return;
    }
    std::lock_guard<std::mutex> running(loop_mutex_, std::adopt_lock);
    start();
    {
      std::lock_guard<std::mutex> lock(mutex_);
      function_ = function;
      context_ = context;
      chunks_ = chunks;
      next_.store(0, std::memory_order_relaxed);
      busy_ = static_cast<int>(workers_.size());
      generation_.fetch_add(1, std::memory_order_release);
    }
    wake_.notify_all();
    take_chunks(function, context, chunks);
    wait_for_workers();
  }

 private:
  // A worker spins this long for the next loop before it sleeps: kernels follow each other within microseconds.
  static constexpr int kSpins = 4000;

  void start() {
    if (owner_ != getpid()) {  // the threads of the parent do not exist in a forked child
      for (std::thread& worker : workers_) worker.detach();
      workers_.clear();
      owner_ = getpid();
    }
    if (!workers_.empty()) return;
    stopping_ = false;
    const std::uint64_t seen = generation_.load();
    for (int i = 1; i < count_; ++i) workers_.emplace_back([this, seen] { work(seen); });
  }

  void stop() {
    if (owner_ == getpid()) {
      {
        std::lock_guard<std::mutex> lock(mutex_);
        stopping_ = true;
        generation_.fetch_add(1, std::memory_order_release);
      }
      wake_.notify_all();
      for (std::thread& worker : workers_) worker.join();
    } else {
      for (std::thread& worker : workers_) worker.detach();
    }
    workers_.clear();
  }

  void work(std::uint64_t seen) {
    inside_loop_ = true;
    while (true) {
      for (int spin = 0; spin < kSpins && generation_.load(std::memory_order_acquire) == seen; ++spin) pause();
      detail::ChunkFunction function;
      void* context;
      std::int64_t chunks;
      {
        std::unique_lock<std::mutex> lock(mutex_);
        wake_.wait(lock, [&] { return generation_.load() != seen; });
        seen = generation_.load();
        if (stopping_) return;
        function = function_;
        context = context_;
        chunks = chunks_;
      }
      take_chunks(function, context, chunks);
      if (busy_.fetch_sub(1, std::memory_order_acq_rel) == 1) {
        std::lock_guard<std::mutex> lock(mutex_);
        done_.notify_one();
      }
    }
  }

  void take_chunks(detail::ChunkFunction function, void* context, std::int64_t chunks) {
    const bool nested = inside_loop_;
    inside_loop_ = true;
    for (std::int64_t chunk = next_.fetch_add(1); chunk < chunks; chunk = next_.fetch_add(1)) function(context, chunk);
    inside_loop_ = nested;
  }

  void wait_for_workers() {
    for (int spin = 0; spin < kSpins && busy_.load(std::memory_order_acquire) > 0; ++spin) pause();
    std::unique_lock<std::mutex> lock(mutex_);
    done_.wait(lock, [&] { return busy_.load(std::memory_order_acquire) == 0; });
  }

  static void pause() {
#if defined(__x86_64__)
    __builtin_ia32_pause();
#endif
  }

  int count_ = static_cast<int>(std::thread::hardware_concurrency() ? std::thread::hardware_concurrency() : 1);
  pid_t owner_ = getpid();
  std::vector<std::thread> workers_;
  std::mutex loop_mutex_, mutex_;
  std::condition_variable wake_, done_;
  std::atomic<std::uint64_t> generation_{0};
  std::atomic<std::int64_t> next_{0};
  std::atomic<int> busy_{0};
  bool stopping_ = false;
  detail::ChunkFunction function_ = nullptr;
  void* context_ = nullptr;
  std::int64_t chunks_ = 0;
  static thread_local bool inside_loop_;
};

thread_local bool ThreadPool::inside_loop_ = false;

// Never destroyed: joining threads while the process's other static objects go away is a known way to hang at exit.
ThreadPool& pool() {
  static ThreadPool* instance = new ThreadPool;
  return *instance;
}

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
