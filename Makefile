# make s1            one experiment: simulate, detect, fuse, score; a table, and out/s1/report.html
# make s1-audio      the same by ear alone (nothing is rendered); s1-video by eye alone, s1-both by both
# make all           s1 s2 s3 s4 and the combined table (make -j2 all uses two cores)
# make test lint     the tests; the style checks
# make man           the manual pages, checked and as HTML in out/man/
# make bench-scene bench-audio bench-localization bench-detection bench-tracking bench-metrics bench-calibration
# make clean         remove out/ (and nothing else); make distclean removes the virtual environment too

SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c
.DELETE_ON_ERROR:
.SECONDARY:
.SUFFIXES:

PYTHON ?= python3
VENV ?= .venv
OUT ?= out
SCENE_FLAGS ?=
AUDIO_FLAGS ?=
DETECT_AUDIO_FLAGS ?=
DETECT_VIDEO_FLAGS ?=
FUSE_FLAGS ?=
EVAL_FLAGS ?=

BIN := $(VENV)/bin
READY := $(VENV)/.ready
SCENARIOS := s1 s2 s3 s4
BENCHES := scene audio localization detection tracking metrics calibration

# The matrices are small: threads inside BLAS cost more than they bring.
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: setup setup-bench all test lint man clean distclean help $(SCENARIOS) $(BENCHES:%=bench-%) \
        $(SCENARIOS:%=%-audio) $(SCENARIOS:%=%-video) $(SCENARIOS:%=%-both)

help:
	@sed -n 's/^# //p' Makefile

# --- set-up -----------------------------------------------------------------------------------------------------------

setup: $(READY)

$(READY): pyproject.toml .ci/setup
	@PYTHON='$(PYTHON)' .ci/setup '$(VENV)'

# --- an experiment ----------------------------------------------------------------------------------------------------

$(OUT)/%-audio/scene.jsonl: | $(READY)
	@mkdir -p $(@D)
	$(BIN)/avsim-scene $* -C $(@D) --no-video $(SCENE_FLAGS) -o $@

$(OUT)/%/scene.jsonl: | $(READY)
	@mkdir -p $(@D)
	$(BIN)/avsim-scene $* -C $(@D) $(SCENE_FLAGS) -o $@

$(OUT)/%/audio.jsonl: $(OUT)/%/scene.jsonl
	$(BIN)/avsim-audio -C $(@D) $(AUDIO_FLAGS) $< -o $@

$(OUT)/%/localization/audio_localizations.jsonl: $(OUT)/%/audio.jsonl
	@mkdir -p $(@D)
	$(BIN)/avdetect-audio -C $(OUT)/$* $(DETECT_AUDIO_FLAGS) $< -o $@

$(OUT)/%/localization/video_localizations.jsonl: $(OUT)/%/scene.jsonl
	@mkdir -p $(@D)
	$(BIN)/avdetect-video -C $(OUT)/$* $(DETECT_VIDEO_FLAGS) $< -o $@

$(OUT)/%/tracking/audio_tracking.jsonl: $(OUT)/%/localization/audio_localizations.jsonl
	@mkdir -p $(@D)
	$(BIN)/avfuse -C $(OUT)/$* $(FUSE_FLAGS) $^ -o $@

$(OUT)/%/tracking/video_tracking.jsonl: $(OUT)/%/localization/video_localizations.jsonl
	@mkdir -p $(@D)
	$(BIN)/avfuse -C $(OUT)/$* $(FUSE_FLAGS) $^ -o $@

$(OUT)/%/tracking/audio_video_tracking.jsonl: $(OUT)/%/localization/audio_localizations.jsonl \
                                              $(OUT)/%/localization/video_localizations.jsonl
	@mkdir -p $(@D)
	$(BIN)/avfuse -C $(OUT)/$* $(FUSE_FLAGS) $^ -o $@

$(OUT)/%/metrics.jsonl: $(OUT)/%/tracking/audio_tracking.jsonl $(OUT)/%/tracking/video_tracking.jsonl \
                        $(OUT)/%/tracking/audio_video_tracking.jsonl
	$(BIN)/aveval --experiments $(@D) --compare-thesis --html $(@D)/report.html --format jsonl $(EVAL_FLAGS) -o $@

$(SCENARIOS): %: $(OUT)/%/metrics.jsonl
	@$(BIN)/aveval --experiments $(OUT)/$@ --format table --compare-thesis $(EVAL_FLAGS)

all: $(SCENARIOS)
	@$(BIN)/aveval --experiments $(SCENARIOS:%=$(OUT)/%) --format table --compare-thesis --html $(OUT)/report.html \
	  $(EVAL_FLAGS)

$(SCENARIOS:%=%-audio): %: $(OUT)/%/tracking/audio_tracking.jsonl
	@$(BIN)/aveval $(OUT)/$@/groundtruth_sources.jsonl $< --format table $(EVAL_FLAGS)

$(SCENARIOS:%=%-video): %-video: $(OUT)/%/tracking/video_tracking.jsonl
	@$(BIN)/aveval $(OUT)/$*/groundtruth_sources.jsonl $< --format table $(EVAL_FLAGS)

$(SCENARIOS:%=%-both): %-both: $(OUT)/%/tracking/audio_video_tracking.jsonl
	@$(BIN)/aveval $(OUT)/$*/groundtruth_sources.jsonl $< --format table $(EVAL_FLAGS)

# --- checks -----------------------------------------------------------------------------------------------------------

test: $(READY)
	$(BIN)/pytest -n 2 $(TEST_FLAGS)

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache

man: | $(READY)
	@command -v mandoc >/dev/null || { echo 'make man: mandoc is missing (Debian: apt-get install mandoc)' >&2; exit 1; }
	@mkdir -p $(OUT)/man
	@for page in man/*.[1-9]; do \
	  mandoc -T lint -W warning "$$page"; \
	  mandoc -T html -O 'man=%N.%S.html' "$$page" >"$(OUT)/man/$$(basename "$$page").html"; \
	done
	@echo 'manual pages as HTML: $(OUT)/man/'

# --- benchmarks -------------------------------------------------------------------------------------------------------

setup-bench: $(READY)
	@test -x .venv-bench/bin/python || $(PYTHON) -m venv .venv-bench
	.venv-bench/bin/pip install -q -e '.[plot,jpda]' pyroomacoustics rir-generator sofar

BENCH_PYTHON = $(BIN)/python
bench-tracking: BENCH_PYTHON = $(if $(wildcard .venv-bench/bin/python),.venv-bench/bin/python,$(BIN)/python)

$(BENCHES:%=bench-%): bench-%: $(READY)
	@mkdir -p bench-out
	$(BENCH_PYTHON) tests/bench/bench_$*.py --out bench-out $(BENCH_FLAGS)

# --- tidying ----------------------------------------------------------------------------------------------------------

clean:
	rm -rf '$(OUT)' bench-out

distclean: clean
	rm -rf '$(VENV)' .venv-bench
