# `make demo` and `make test` set up everything they need in .venv; `make help` lists the rest.
# PYTHON=... uses an environment of your own instead, in which `pip install -e '.[dev]'` was done.
TORCH ?= 2.13.0
JOBS ?= $(shell nproc)
# On a terminal pip shows how far it is.
PIP := --disable-pip-version-check $(if $(MAKE_TERMOUT),,--quiet)
SPSLAM_CUDA ?= OFF
CUDA_ARCHS ?= 90-real

ifeq ($(origin PYTHON), undefined)
PYTHON := .venv/bin/python
ENVIRONMENT := .venv/ready
COMMAND := .venv/bin/spslam
else
COMMAND := $(PYTHON) -m spslam
endif
# Commands that come with the environment are looked for beside its Python first.
RUN = PATH="$(dir $(abspath $(PYTHON))):$$PATH"
# A process per core takes files of tests in turn; threads that wait for work leave the core to the other processes.
PYTEST = OMP_WAIT_POLICY=passive $(PYTHON) -m pytest -n $(JOBS) --dist loadfile
# This machine's best instruction set is all that development needs.
NATIVE_ISA = $$($(PYTHON) -c "import torch; c = torch.backends.cpu.get_cpu_capability(); \
  print({'AVX512': 'avx512', 'AVX2': 'avx2'}.get(c, 'baseline'))")

.PHONY: help demo test test-all test-sweeps test-ray test-gpu dev lint example-cpp test-numpy test-asan

help:
	@grep -E '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed 's/:.*## /\t/'

demo: dev ## track and map a generated room with exact ground truth, into runs/demo
	$(COMMAND) demo

test: dev ## build, then run the tests on the CPU, without the slow sweeps
	$(PYTEST)

test-all: dev ## the same with the slow tests, before a change lands
	$(PYTEST) -m "not sweep"

test-sweeps: dev ## the longest sweeps, which test-all leaves out too
	$(PYTEST) -m sweep

test-ray: dev ## install Ray and run the tests on a cluster of two nodes, both on this machine
	$(PYTHON) -m pip install $(PIP) $$($(PYTHON) cmake/requirements.py cluster)
	$(PYTHON) -m pytest -m "" tests/tasks/test_ray.py

test-gpu: ## run the tests that need a CUDA device, with the kernels that are there: built in place, or a wheel's
	$(PYTHON) tests/run_on_gpu.py

dev: $(ENVIRONMENT) ## build the kernels in place for this machine; SPSLAM_CUDA=ON for CUDA too
	$(RUN) cmake -S . -B build/dev-$(SPSLAM_CUDA) -G Ninja \
	  -DCMAKE_INSTALL_PREFIX=$(CURDIR) -DSPSLAM_CUDA=$(SPSLAM_CUDA) -DSPSLAM_CUDA_ARCHS="$(CUDA_ARCHS)" \
	  -DSPSLAM_CPU_ISAS=$(NATIVE_ISA) -DSPSLAM_TORCH_DIR=$$($(PYTHON) cmake/spslam_build.py)
	$(RUN) cmake --build build/dev-$(SPSLAM_CUDA) -j $(JOBS)
	$(RUN) cmake --install build/dev-$(SPSLAM_CUDA) --component python > /dev/null
	$(RUN) cmake --install build/dev-$(SPSLAM_CUDA) --component images > /dev/null

example-cpp: $(ENVIRONMENT) ## install the kernels for C++ into build/prefix, without torch, and run examples/cpp on them
	$(RUN) cmake -S . -B build/cxx -G Ninja -DSPSLAM_CUDA=OFF -DSPSLAM_CPU_ISAS=baseline -DSPSLAM_TORCH_DIR= \
	  -DCMAKE_INSTALL_PREFIX=$(CURDIR)/build/prefix
	$(RUN) cmake --build build/cxx -j $(JOBS)
	$(RUN) cmake --install build/cxx > /dev/null
	$(RUN) cmake -S examples/cpp -B build/example-cpp -G Ninja -DCMAKE_PREFIX_PATH=$(CURDIR)/build/prefix
	$(RUN) cmake --build build/example-cpp
	$(RUN) ctest --test-dir build/example-cpp --output-on-failure
	$(RUN) cmake -S tests/cpp -B build/cpp-installed -G Ninja -DCMAKE_PREFIX_PATH=$(CURDIR)/build/prefix
	$(RUN) cmake --build build/cpp-installed
	$(RUN) ctest --test-dir build/cpp-installed --output-on-failure
	$(RUN) cmake -S tests/cpp -B build/cpp-sources -G Ninja -DSPSLAM_SOURCE=$(CURDIR) -DSPSLAM_CPU_ISAS=baseline
	$(RUN) cmake --build build/cpp-sources -j $(JOBS)
	$(RUN) ctest --test-dir build/cpp-sources --output-on-failure
	@if command -v pkg-config > /dev/null; then \
	  flags=$$(PKG_CONFIG_PATH=build/prefix/lib/pkgconfig:build/prefix/lib64/pkgconfig pkg-config --cflags --libs spslam) && \
	  $(CXX) -std=c++17 -o build/use-spslam tests/cpp/use_spslam.cpp $$flags && build/use-spslam; \
	  else echo "pkg-config is not installed: spslam.pc goes untested"; fi

test-numpy: dev ## install bindings/numpy and test it against the torch ops
	$(RUN) SPSLAM_CPU_ISAS=$(NATIVE_ISA) $(PYTHON) -m pip install $(PIP) --no-deps \
	  --force-reinstall ./bindings/numpy
	$(PYTHON) -m pytest bindings/numpy/tests

test-asan: $(ENVIRONMENT) ## the tests of compiled functions on the CPU with address and undefined-behavior sanitizers
	$(RUN) cmake -S . -B build/asan -G Ninja -DCMAKE_BUILD_TYPE=RelWithDebInfo -DSPSLAM_SANITIZE=ON -DSPSLAM_CUDA=OFF \
	  -DSPSLAM_CPU_ISAS=$(NATIVE_ISA) -DSPSLAM_TORCH_DIR=$$($(PYTHON) cmake/spslam_build.py)
	$(RUN) cmake --build build/asan -j $(JOBS)
	rm -rf build/asan-site && mkdir build/asan-site
	cp -r spslam tests configs pyproject.toml build/asan-site && rm -f build/asan-site/spslam/*.so
	$(RUN) cmake --install build/asan --component python --prefix build/asan-site > /dev/null
	$(RUN) cmake --install build/asan --component images --prefix build/asan-site > /dev/null
	cd build/asan-site && LD_PRELOAD="$$(gcc -print-file-name=libasan.so) $$(gcc -print-file-name=libubsan.so)" \
	  ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 $(abspath $(PYTHON)) -m pytest --capture=sys -m "not cuda" tests/ops \
	  tests/datasets/test_image_kernels.py tests/datasets/test_png.py tests/meshing/test_render.py tests/meshing/test_topology.py \
	  tests/slam/test_orb_features.py tests/slam/test_feature_equations.py tests/slam/test_pose_confidence.py tests/slam/test_rolling_shutter.py

fuzz: dev ## read corrupted files of every format for MINUTES (60), in JOBS processes; see docs/reliability.md
	$(PYTHON) -m tests.fuzz --minutes $(or $(MINUTES),60) --jobs $(JOBS)

lint: $(ENVIRONMENT) ## style and types
	$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .
	$(RUN) clang-format --dry-run --Werror $$(git ls-files 'csrc/*.h' 'csrc/*.cpp' 'csrc/*.cu' 'csrc/*.cuh' \
	  'examples/*.h' 'examples/*.cpp' 'tests/*.cpp' 'bindings/*.h' 'bindings/*.cpp')
	$(PYTHON) -m mypy

# torch first and pinned: a plain 'torch' may bring gigabytes of CUDA libraries. The package is installed as a link to
# this folder, with the command; `dev` builds its kernels.
.venv/ready: pyproject.toml
	@python3 -c 'import sys; sys.exit(sys.version_info < (3, 10) and "spslam needs Python 3.10 or later, got " + sys.version)'
	@for c in $(CXX) c++ clang++; do command -v $$c > /dev/null && exit 0; done; \
	  echo "spslam needs a C++17 compiler such as g++" >&2; exit 1
	python3 -m venv .venv
	@echo "Installing torch $(TORCH) and the other requirements into .venv, a few minutes"
	.venv/bin/python -m pip install $(PIP) torch==$(TORCH) "setuptools>=77"
	.venv/bin/python -m pip install $(PIP) $$(.venv/bin/python cmake/requirements.py dev)
	SPSLAM_BUILD=OFF .venv/bin/python -m pip install $(PIP) --no-build-isolation --no-deps --editable .
	touch $@
