// Vectors as wide as the instruction set this file is compiled for, and memory aligned for them.
//
// GCC's vector extension: plain operators, no intrinsics, the same source for every instruction set.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <new>

namespace spslam {

#if defined(__AVX512F__)
constexpr int kVectorBytes = 64;
constexpr int kVectorRegisters = 32;
#elif defined(__AVX2__)
constexpr int kVectorBytes = 32;
constexpr int kVectorRegisters = 16;
#else
constexpr int kVectorBytes = 16;
constexpr int kVectorRegisters = 16;
#endif

template <class T, int Bytes>
struct VectorOf {
  typedef T type __attribute__((vector_size(Bytes)));
};

template <class T, int Bytes = kVectorBytes>
using Vector = typename VectorOf<T, Bytes>::type;

template <class T>
constexpr int kLanes = kVectorBytes / static_cast<int>(sizeof(T));

template <class V, class T>
inline __attribute__((always_inline)) V load_vector(const T* p) {
  V v;
  __builtin_memcpy(&v, p, sizeof v);
  return v;
}

template <class V, class T>
inline __attribute__((always_inline)) void store_vector(T* p, const V& v) {
  __builtin_memcpy(p, &v, sizeof v);
}

// Has the compiler load a vector once into a register. Left alone it reads memory again in every multiply-add that the
// vector takes part in, and loads are what inner kernels then wait for.
template <class V>
inline __attribute__((always_inline)) void hold_in_register(V& v) {
#if defined(__AVX512F__)
  asm("" : "+v"(v));
#elif defined(__x86_64__)
  asm("" : "+x"(v));
#elif defined(__aarch64__)
  asm("" : "+w"(v));
#else
  static_cast<void>(v);
#endif
}

// Sum of the lanes, by halving.
template <class T, int Bytes>
struct LaneSum {
  static inline __attribute__((always_inline)) T of(const Vector<T, Bytes>& v) {
    struct Halves {
      Vector<T, Bytes / 2> low, high;
    } halves;
    __builtin_memcpy(&halves, &v, sizeof v);
    return LaneSum<T, Bytes / 2>::of(halves.low + halves.high);
  }
};
template <class T>
struct LaneSum<T, static_cast<int>(2 * sizeof(T))> {
  static inline __attribute__((always_inline)) T of(const Vector<T, static_cast<int>(2 * sizeof(T))>& v) {
    return v[0] + v[1];
  }
};

template <class T, int Bytes = kVectorBytes>
inline __attribute__((always_inline)) T sum_lanes(const Vector<T, Bytes>& v) {
  return LaneSum<T, Bytes>::of(v);
}

constexpr std::int64_t round_up(std::int64_t n, std::int64_t multiple) {
  return (n + multiple - 1) / multiple * multiple;
}

// Memory that only grows, for scratch that a thread reuses. Its content is lost when it grows.
template <class T>
class ScratchBuffer {
 public:
  ScratchBuffer() = default;
  ScratchBuffer(const ScratchBuffer&) = delete;
  ScratchBuffer& operator=(const ScratchBuffer&) = delete;
  ~ScratchBuffer() { std::free(data_); }

  // Never null, so that filling 0 elements is defined too.
  T* reserve(std::int64_t count) {
    if (count < 1) count = 1;
    if (count > capacity_) {
      std::free(data_);
      data_ = nullptr;
      capacity_ = 0;
      constexpr std::int64_t kAlignment = 64;
      const std::int64_t bytes = round_up(count * static_cast<std::int64_t>(sizeof(T)), kAlignment);
      data_ = static_cast<T*>(std::aligned_alloc(kAlignment, static_cast<std::size_t>(bytes)));
      if (!data_) throw std::bad_alloc();
      capacity_ = count;
    }
    return data_;
  }

  T* get() const { return data_; }

 private:
  T* data_ = nullptr;
  std::int64_t capacity_ = 0;
};

}  // namespace spslam
