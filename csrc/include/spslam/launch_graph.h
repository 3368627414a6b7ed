// A CUDA graph that a caller keeps from call to call.
#pragma once

namespace spslam {

class LaunchGraph;

LaunchGraph* make_launch_graph();
// Launches in progress finish all the same.
void free_launch_graph(LaunchGraph* graph);
// How often it was built: for the first call, and after each change of a call's shape.
int launch_graph_builds(const LaunchGraph* graph);

}  // namespace spslam
