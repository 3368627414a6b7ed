// CUDA graphs that Python objects own, by number; 0 is none.
#pragma once

#include "bindings/common.h"

namespace spslam {
class LaunchGraph;
}

namespace spslam::bindings {

// The graph of that number; null for 0, and always on the CPU.
LaunchGraph* find_launch_graph(std::int64_t number);

}  // namespace spslam::bindings
