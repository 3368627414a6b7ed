# `make dev` builds the kernels in place; `make test` builds them and runs the tests; `make help` lists the rest.
PYTHON ?= python
JOBS ?= 2
SPSLAM_CUDA ?= OFF
CUDA_ARCHS ?= 90-real
# This machine's best instruction set is all that development needs.
ISA := $(shell $(PYTHON) -c "import torch; print({'AVX512': 'avx512', 'AVX2': 'avx2'}.get(torch.backends.cpu.get_cpu_capability(), 'baseline'))")

.PHONY: help dev test test-gpu lint demo

help:
	@grep -E '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed 's/:.*## /\t/'

dev: ## build the kernels in place for this machine
	cmake -S . -B build/dev-$(SPSLAM_CUDA) -G Ninja -DCMAKE_INSTALL_PREFIX=$(CURDIR) -DSPSLAM_CUDA=$(SPSLAM_CUDA) \
	  -DSPSLAM_CUDA_ARCHS="$(CUDA_ARCHS)" -DSPSLAM_CPU_ISAS=$(ISA) \
	  -DSPSLAM_TORCH_DIR=$$($(PYTHON) -c "import importlib.util as u; print(u.find_spec('torch').submodule_search_locations[0])")
	cmake --build build/dev-$(SPSLAM_CUDA) -j $(JOBS)
	cmake --install build/dev-$(SPSLAM_CUDA) > /dev/null

test: dev ## build, then run the tests on the CPU
	$(PYTHON) -m pytest

test-gpu: ## run the tests on a CUDA device, against the installed or in-place build
	$(PYTHON) -m pytest -m cuda

lint: ## style and types
	$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .
	clang-format --dry-run --Werror $$(git ls-files 'csrc/*.h' 'csrc/*.cpp' 'csrc/*.cu' 'csrc/*.cuh')
	$(PYTHON) -m mypy

demo: dev ## a generated room with known truth, into runs/demo
	$(PYTHON) -m spslam.cli.main demo
