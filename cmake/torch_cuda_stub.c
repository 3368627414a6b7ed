/* Link-time stand-in for libtorch_cuda.so, for machines with a CPU build of torch: the same SONAME and only the C
   functions that the stable ABI's headers call. Never installed, never loaded. */
int torch_c10_cuda_check_msg(void) { return 0; }
void torch_c10_cuda_free_error_msg(void) {}
int aoti_torch_get_current_cuda_stream(void) { return 0; }
