// The CPU's parallel loop: a small thread pool of our own, so that the kernels need neither OpenMP nor torch.
#pragma once

#include <cstdint>

namespace spslam {

// Threads that parallel_for may use, the calling one included. Default: the machine's cores.
void set_num_threads(int count);
int get_num_threads();

namespace detail {
using ChunkFunction = void (*)(void* context, std::int64_t chunk);
void run_chunks(std::int64_t chunks, ChunkFunction function, void* context);
}  // namespace detail

inline std::int64_t chunk_count(std::int64_t n, std::int64_t grain) {
  return (n + grain - 1) / grain;
}

// Calls f(chunk, begin, end) for [0, n) cut into chunks of `grain`. The chunks depend on n and grain only, never on the
// number of threads, so sums kept per chunk and added in chunk order do not depend on it either. f must not throw.
template <class F>
void parallel_chunks(std::int64_t n, std::int64_t grain, const F& f) {
  struct Context {
    std::int64_t n, grain;
    const F* f;
  } context{n, grain, &f};
  detail::run_chunks(
      chunk_count(n, grain),
      [](void* raw, std::int64_t chunk) {
        const Context& c = *static_cast<Context*>(raw);
        const std::int64_t begin = chunk * c.grain;
        const std::int64_t end = begin + c.grain < c.n ? begin + c.grain : c.n;
        (*c.f)(chunk, begin, end);
      },
      &context);
}

// Calls f(begin, end) for [0, n) cut into chunks of `grain`.
template <class F>
void parallel_for(std::int64_t n, std::int64_t grain, const F& f) {
  parallel_chunks(n, grain, [&f](std::int64_t, std::int64_t begin, std::int64_t end) { f(begin, end); });
}

}  // namespace spslam
