// Sums of a few terms over many elements, added in an order that does not depend on the number of threads.
#pragma once

#include <cstdint>

#include "core/parallel.h"

namespace spslam {

// terms[kTerms] = the sums that add(begin, end, own) adds up over [0, n), chunk by chunk in order. partials has room
// for kTerms per chunk.
template <int kTerms, class Add>
void sum_terms(std::int64_t n, std::int64_t grain, double* partials, double* terms, const Add& add) {
  parallel_chunks(n, grain, [&](std::int64_t chunk, std::int64_t begin, std::int64_t end) {
    double* own = partials + chunk * kTerms;
    for (int t = 0; t < kTerms; ++t) own[t] = 0.0;
    add(begin, end, own);
  });
  for (int t = 0; t < kTerms; ++t) terms[t] = 0.0;
  for (std::int64_t chunk = 0; chunk < chunk_count(n, grain); ++chunk) {
    for (int t = 0; t < kTerms; ++t) terms[t] += partials[chunk * kTerms + t];
  }
}

}  // namespace spslam
