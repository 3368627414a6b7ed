# `make demo` and `make test` set up everything they need in .venv; `make help` lists the rest.
# PYTHON=... uses an environment of your own instead, in which `pip install -e '.[dev]'` was done.
TORCH ?= 2.13.0
JOBS ?= $(shell nproc)
SPSLAM_CUDA ?= OFF
CUDA_ARCHS ?= 90-real

ifeq ($(origin PYTHON), undefined)
PYTHON := .venv/bin/python
ENVIRONMENT := .venv/ready
endif
# Commands that come with the environment are looked for beside its Python first.
RUN = PATH="$(dir $(abspath $(PYTHON))):$$PATH"
# This machine's best instruction set is all that development needs.
NATIVE_ISA = $$($(PYTHON) -c "import torch; c = torch.backends.cpu.get_cpu_capability(); \
  print({'AVX512': 'avx512', 'AVX2': 'avx2'}.get(c, 'baseline'))")

.PHONY: help demo test test-gpu dev lint example-cpp test-numpy test-asan

help:
	@grep -E '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed 's/:.*## /\t/'

demo: dev ## track and map a generated room with known truth, into runs/demo
	$(PYTHON) -m spslam.cli.main demo

test: dev ## build, then run the tests on the CPU
	$(PYTHON) -m pytest

test-gpu: ## run the tests that need a CUDA device, with the kernels that are there: built in place, or a wheel's
	$(PYTHON) tests/run_on_gpu.py

dev: $(ENVIRONMENT) ## build the kernels in place for this machine; SPSLAM_CUDA=ON for CUDA too
	$(RUN) cmake -S . -B build/dev-$(SPSLAM_CUDA) -G Ninja \
	  -DCMAKE_INSTALL_PREFIX=$(CURDIR) -DSPSLAM_CUDA=$(SPSLAM_CUDA) -DSPSLAM_CUDA_ARCHS="$(CUDA_ARCHS)" \
	  -DSPSLAM_CPU_ISAS=$(NATIVE_ISA) -DSPSLAM_TORCH_DIR=$$($(PYTHON) cmake/spslam_build.py)
	$(RUN) cmake --build build/dev-$(SPSLAM_CUDA) -j $(JOBS)
	$(RUN) cmake --install build/dev-$(SPSLAM_CUDA) --component python > /dev/null

example-cpp: $(ENVIRONMENT) ## install the kernels for C++ into build/prefix, without torch, and run examples/cpp on them
	$(RUN) cmake -S . -B build/cxx -G Ninja -DSPSLAM_CUDA=OFF -DSPSLAM_CPU_ISAS=baseline -DSPSLAM_TORCH_DIR= \
	  -DCMAKE_INSTALL_PREFIX=$(CURDIR)/build/prefix
	$(RUN) cmake --build build/cxx -j $(JOBS)
	$(RUN) cmake --install build/cxx > /dev/null
	$(RUN) cmake -S examples/cpp -B build/example-cpp -G Ninja -DCMAKE_PREFIX_PATH=$(CURDIR)/build/prefix
	$(RUN) cmake --build build/example-cpp
	$(RUN) ctest --test-dir build/example-cpp --output-on-failure

test-numpy: dev ## install bindings/numpy and test it against the torch ops
	SPSLAM_CPU_ISAS=$(NATIVE_ISA) $(PYTHON) -m pip install --quiet --disable-pip-version-check --no-deps \
	  --force-reinstall ./bindings/numpy
	$(PYTHON) -m pytest bindings/numpy/tests

test-asan: $(ENVIRONMENT) ## the tests of the CPU ops with address and undefined-behavior sanitizers
	$(RUN) cmake -S . -B build/asan -G Ninja -DCMAKE_BUILD_TYPE=RelWithDebInfo -DSPSLAM_SANITIZE=ON -DSPSLAM_CUDA=OFF \
	  -DSPSLAM_CPU_ISAS=$(NATIVE_ISA) -DSPSLAM_TORCH_DIR=$$($(PYTHON) cmake/spslam_build.py)
	$(RUN) cmake --build build/asan -j $(JOBS)
	rm -rf build/asan-site && mkdir build/asan-site
	cp -r spslam tests configs pyproject.toml build/asan-site && rm -f build/asan-site/spslam/*.so
	$(RUN) cmake --install build/asan --component python --prefix build/asan-site > /dev/null
	cd build/asan-site && LD_PRELOAD="$$(gcc -print-file-name=libasan.so) $$(gcc -print-file-name=libubsan.so)" \
	  ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 $(abspath $(PYTHON)) -m pytest --capture=sys -m "not cuda" tests/ops

fuzz: dev ## read spoiled files of every format for MINUTES (60), in JOBS processes; see docs/reliability.md
	$(PYTHON) -m tests.fuzz --minutes $(or $(MINUTES),60) --jobs $(JOBS)

lint: $(ENVIRONMENT) ## style and types
	$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .
	$(RUN) clang-format --dry-run --Werror $$(git ls-files 'csrc/*.h' 'csrc/*.cpp' 'csrc/*.cu' 'csrc/*.cuh' \
	  'examples/*.h' 'examples/*.cpp' 'bindings/*.h' 'bindings/*.cpp')
	$(PYTHON) -m mypy

# torch first and pinned: a plain 'torch' may bring gigabytes of CUDA libraries.
.venv/ready: pyproject.toml
	python3 -m venv .venv
	.venv/bin/python -m pip install --quiet --disable-pip-version-check torch==$(TORCH) setuptools
	.venv/bin/python -m pip install --quiet --disable-pip-version-check $$(.venv/bin/python cmake/requirements.py dev)
	touch $@
