#: make s1            one experiment: simulate, detect, fuse, score; prints a table, writes out/s1/report.html
#: make s1-audio      the same with microphones alone (nothing is rendered); s1-video camera alone; s1-both fused alone
#: make all           s1 s2 s3 s4 and the combined table (two stages at once; make -j4 all uses four cores)
#: make run SCENARIO=mine.json [MODALITIES=all|audio|video|both]      your own scenario, in out/mine
#: make setup         the virtual environment with everything that the targets need; each target calls it
#: make test          the tests
#: make lint          the checks of style, types and imports
#: make man           the manual pages, checked, and as HTML in out/man/
#: make docs          the site: tutorial, how-tos, methods, manuals, in out/site/index.html
#: make tutorial      runs every command of the tutorial and the how-tos, and compares what they print with the pages
#: make formats       the schemas and the key lists of the manual, from the one description of each format
#: make bench-scene bench-sensor bench-audio bench-localization bench-scores bench-faults bench-steady bench-detection bench-tracking
#:      bench-metrics bench-calibration bench-microphones
#: make bench-guidance            pictures that people need with the hints of avcalib live, and without
#: make datasets      MOT25A, MOT25V, MOT25AV, MOT26 in out/datasets, in MOTChallenge's layout (DATASETS_FLAGS)
#: make bench-datasets            trackers on them: BENCH_FLAGS="--data out/datasets/MOT26"
#: make bench-live bench-long     latency with input in real time; time and memory over an hour
#: make bench-pipe                one experiment as one pipe: wall time, and the share of each stage
#: make bench-rooms               furnished rooms of materials: T30, EDT, coherence, beside theory and ray tracing
#: make bench-worlds              random worlds through the whole pipeline: failures, warnings, HOTA, sheets of pictures
#: make bench-real-video          people in real ceiling pictures that you have: BENCH_FLAGS="--data DIR --model FILE.onnx"
#: make bench-real-audio          talkers in measured rooms that you have: BENCH_FLAGS="--data DIR"
#: make setup-bench   the peers that some benchmarks compare with
#: make bench         the pipeline and all stage benchmarks in short, on one page: out/bench/index.html
#:                    (BENCH_FLAGS=--all: as long as they take; --check: exit 1 where something costs more than its budget,
#:                    or has none)
#: make stress        random worlds, sounds, pictures, detections, faults and damaged files for ten minutes; what was lost, if
#:                    anything (STRESS_FLAGS="--seconds 3600")
#: make thesis        S1 to S4 as the thesis built its chain, beside ours, each part exchanged by itself (THESIS_FLAGS="--seeds 5")
#: make study         the thesis's hypotheses with intervals, and one factor of the scene at a time (STUDY_FLAGS="--seeds 20")
#: make fit-localization fit-scores fit-directions fit-line fit-voice fit-detection fit-looks fit-tracking fit-existence fit-pupil
#:                    the coefficients of the stages, fitted again (minutes each; fit-voice needs recordings:
#:                    FIT_FLAGS="--speech DIR"; fit-pupil folders of pictures of boards: FIT_FLAGS="DIR/*";
#:                    fit-existence walks and films: FIT_FLAGS="--walks OPENTRAJ --films CASES")
#: make clean         removes out/ and bench-out/; make distclean removes the virtual environments too
#:
#: Variables: OUT=out SEED=0 PYTHON=python3 VENV=.venv
#:   SCENE_FLAGS AUDIO_FLAGS DETECT_AUDIO_FLAGS DETECT_VIDEO_FLAGS FUSE_FLAGS EVAL_FLAGS: options of the stages
#:   TEST_FLAGS BENCH_FLAGS STRESS_FLAGS THESIS_FLAGS STUDY_FLAGS FIT_FLAGS: options of pytest, and of the other targets
#: A target runs again exactly the stages whose inputs, options or code have changed: make s3 FUSE_FLAGS='--lag inf'

SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c
.DELETE_ON_ERROR:
.SECONDARY:
.SUFFIXES:

PYTHON ?= python3
VENV ?= .venv
OUT ?= out
SEED ?= 0
SCENARIO ?=
MODALITIES ?= all
SCENE_FLAGS ?=
AUDIO_FLAGS ?=
DETECT_AUDIO_FLAGS ?=
DETECT_VIDEO_FLAGS ?=
FUSE_FLAGS ?=
EVAL_FLAGS ?=

BIN := $(VENV)/bin
READY := $(VENV)/.ready
NAME := $(basename $(notdir $(SCENARIO)))
SCENARIO_FILE := $(wildcard $(SCENARIO))
SCENARIOS := s1 s2 s3 s4
BENCHES := scene sensor audio decay localization scores faults steady detection tracking metrics calibration guidance microphones live pipe \
           rooms worlds long real-video real-audio beam datasets
FITS := localization scores directions line voice detection looks tracking existence pupil

# The stages that do not wait for each other run at once, unless make -j1; what measures time runs alone.
ifeq ($(filter bench% fit-% stress thesis study,$(MAKECMDGOALS)),)
MAKEFLAGS += -j2
endif

# The matrices are small: threads inside BLAS cost more than they bring.
export OPENBLAS_NUM_THREADS ?= 1

ifneq ($(words $(OUT)) $(words $(VENV)),1 1)
  $(error OUT='$(OUT)' VENV='$(VENV)': each needs a path without spaces)
endif
ifneq ($(words $(SCENARIO)),1)
  ifneq ($(filter run run-%,$(MAKECMDGOALS)),)
    $(error make run needs SCENARIO=FILE.json, a path without spaces)
  endif
endif
ifneq ($(filter %-audio,$(NAME)),)
  $(error $(SCENARIO): rename the scenario; out/NAME-audio is the directory of the scenario NAME by microphones alone)
endif

.PHONY: FORCE bench stress thesis study run run-all run-audio run-video run-both setup setup-bench all test lint man clean \
        distclean help formats datasets setup-docs docs tutorial $(SCENARIOS) $(BENCHES:%=bench-%) $(FITS:%=fit-%) \
        $(SCENARIOS:%=%-audio) $(SCENARIOS:%=%-video) $(SCENARIOS:%=%-both)

help:
	@sed -n 's/^#: \?//p' Makefile

# --- set-up -----------------------------------------------------------------------------------------------------------

setup: $(READY)

$(READY): pyproject.toml .ci/setup
	@PYTHON='$(PYTHON)' .ci/setup '$(VENV)'

# --- an experiment ----------------------------------------------------------------------------------------------------
# Each stage depends on its options: DIR/.options/STAGE holds them, and is written again only when they change. It depends
# on its code too: what an older version has made is not scored as if today's had made it.

code_of = $(shell find avcli/*.py avcli/commands avcli/formats avcli/lens avcli/$1 -type f ! -name '*.pyc')
SCENE_CODE := $(call code_of,scene)
AUDIO_CODE := $(call code_of,acoustics)
DETECT_AUDIO_CODE := $(call code_of,localization)
DETECT_VIDEO_CODE := $(call code_of,detection)
FUSE_CODE := $(call code_of,tracking)
EVAL_CODE := $(call code_of,metrics) $(call code_of,view)

export SCENE_OPTIONS = $(SCENARIO) --seed $(SEED) $(SCENE_FLAGS)
export AUDIO_OPTIONS = --seed $(SEED) $(AUDIO_FLAGS)
export DETECT_AUDIO_OPTIONS = --seed $(SEED) $(DETECT_AUDIO_FLAGS)
export DETECT_VIDEO_OPTIONS = $(DETECT_VIDEO_FLAGS)
export FUSE_OPTIONS = $(FUSE_FLAGS)
export EVAL_OPTIONS = $(EVAL_FLAGS)

define remember_options
@mkdir -p '$(@D)'
@printf '%s\n' "$$$(1)_OPTIONS" | cmp -s - '$@' || printf '%s\n' "$$$(1)_OPTIONS" >'$@'
endef

$(OUT)/%/.options/scene: FORCE
	$(call remember_options,SCENE)
$(OUT)/%/.options/audio: FORCE
	$(call remember_options,AUDIO)
$(OUT)/%/.options/detect-audio: FORCE
	$(call remember_options,DETECT_AUDIO)
$(OUT)/%/.options/detect-video: FORCE
	$(call remember_options,DETECT_VIDEO)
$(OUT)/%/.options/fuse: FORCE
	$(call remember_options,FUSE)
$(OUT)/%/.options/eval: FORCE
	$(call remember_options,EVAL)

# What to simulate in a directory: the user's file where the directory has its name, else the built-in scenario.
scenario = $(if $(filter $(NAME),$1),$(SCENARIO),$1)

$(OUT)/%-audio/scene.jsonl: $(OUT)/%-audio/.options/scene $(SCENARIO_FILE) $(SCENE_CODE) | $(READY)
	$(BIN)/avsim-scene $(call scenario,$*) -C $(@D) --no-video --seed $(SEED) $(SCENE_FLAGS) -o $@

$(OUT)/%/scene.jsonl: $(OUT)/%/.options/scene $(SCENARIO_FILE) $(SCENE_CODE) | $(READY)
	$(BIN)/avsim-scene $(call scenario,$*) -C $(@D) --seed $(SEED) $(SCENE_FLAGS) -o $@

$(OUT)/%/audio.jsonl: $(OUT)/%/scene.jsonl $(OUT)/%/.options/audio $(AUDIO_CODE)
	$(BIN)/avsim-audio -C $(@D) --seed $(SEED) $(AUDIO_FLAGS) $< -o $@

$(OUT)/%/localization/audio_localizations.jsonl: $(OUT)/%/audio.jsonl $(OUT)/%/.options/detect-audio $(DETECT_AUDIO_CODE)
	@mkdir -p $(@D)
	$(BIN)/avdetect-audio -C $(OUT)/$* --seed $(SEED) $(DETECT_AUDIO_FLAGS) $< -o $@

$(OUT)/%/localization/video_localizations.jsonl: $(OUT)/%/scene.jsonl $(OUT)/%/.options/detect-video $(DETECT_VIDEO_CODE)
	@mkdir -p $(@D)
	$(BIN)/avdetect-video -C $(OUT)/$* $(DETECT_VIDEO_FLAGS) $< -o $@

$(OUT)/%/tracking/audio_tracking.jsonl: $(OUT)/%/localization/audio_localizations.jsonl $(OUT)/%/.options/fuse $(FUSE_CODE)
	@mkdir -p $(@D)
	$(BIN)/avfuse -C $(OUT)/$* $(FUSE_FLAGS) $(filter %.jsonl,$^) -o $@

$(OUT)/%/tracking/video_tracking.jsonl: $(OUT)/%/localization/video_localizations.jsonl $(OUT)/%/.options/fuse $(FUSE_CODE)
	@mkdir -p $(@D)
	$(BIN)/avfuse -C $(OUT)/$* $(FUSE_FLAGS) $(filter %.jsonl,$^) -o $@

$(OUT)/%/tracking/audio_video_tracking.jsonl: $(OUT)/%/localization/audio_localizations.jsonl \
                                              $(OUT)/%/localization/video_localizations.jsonl $(OUT)/%/.options/fuse $(FUSE_CODE)
	@mkdir -p $(@D)
	$(BIN)/avfuse -C $(OUT)/$* $(FUSE_FLAGS) $(filter %.jsonl,$^) -o $@

$(OUT)/%/metrics.jsonl: $(OUT)/%/tracking/audio_tracking.jsonl $(OUT)/%/tracking/video_tracking.jsonl \
                        $(OUT)/%/tracking/audio_video_tracking.jsonl $(OUT)/%/.options/eval $(EVAL_CODE)
	$(BIN)/aveval --experiments $(@D) --compare-thesis --html $(@D)/report.html --format jsonl $(EVAL_FLAGS) -o $@

# The table is made while the page is: each has a processor to itself.
$(OUT)/%/metrics.txt: $(OUT)/%/tracking/audio_tracking.jsonl $(OUT)/%/tracking/video_tracking.jsonl \
                      $(OUT)/%/tracking/audio_video_tracking.jsonl $(OUT)/%/.options/eval $(EVAL_CODE)
	@$(BIN)/aveval --experiments $(@D) --format table --compare-thesis $(EVAL_FLAGS) -o $@

$(SCENARIOS): %: $(OUT)/%/metrics.jsonl $(OUT)/%/metrics.txt
	@cat $(OUT)/$@/metrics.txt

all: $(SCENARIOS)
	@$(BIN)/aveval --experiments $(SCENARIOS:%=$(OUT)/%) --format table --compare-thesis --html $(OUT)/report.html \
	  $(EVAL_FLAGS)

$(SCENARIOS:%=%-audio): %: $(OUT)/%/tracking/audio_tracking.jsonl
	@$(BIN)/aveval $(OUT)/$@/groundtruth_sources.jsonl $< --format table $(EVAL_FLAGS)

$(SCENARIOS:%=%-video): %-video: $(OUT)/%/tracking/video_tracking.jsonl
	@$(BIN)/aveval $(OUT)/$*/groundtruth_sources.jsonl $< --format table $(EVAL_FLAGS)

$(SCENARIOS:%=%-both): %-both: $(OUT)/%/tracking/audio_video_tracking.jsonl
	@$(BIN)/aveval $(OUT)/$*/groundtruth_sources.jsonl $< --format table $(EVAL_FLAGS)

run: run-$(MODALITIES)

run-all: $(OUT)/$(NAME)/metrics.jsonl
	@$(BIN)/aveval --experiments $(<D) --format table $(EVAL_FLAGS)

run-audio: $(OUT)/$(NAME)-audio/tracking/audio_tracking.jsonl
	@$(BIN)/aveval $(OUT)/$(NAME)-audio/groundtruth_sources.jsonl $< --format table $(EVAL_FLAGS)

run-video: $(OUT)/$(NAME)/tracking/video_tracking.jsonl
	@$(BIN)/aveval $(OUT)/$(NAME)/groundtruth_sources.jsonl $< --format table $(EVAL_FLAGS)

run-both: $(OUT)/$(NAME)/tracking/audio_video_tracking.jsonl
	@$(BIN)/aveval $(OUT)/$(NAME)/groundtruth_sources.jsonl $< --format table $(EVAL_FLAGS)

# --- checks -----------------------------------------------------------------------------------------------------------

test: $(READY)
	$(BIN)/pytest -n 2 $(TEST_FLAGS)

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache
	$(BIN)/mypy -p avcli
	$(BIN)/mypy tests/bench
	$(BIN)/python -m avcli.formats --check

formats: | $(READY)
	$(BIN)/python -m avcli.formats

man: | $(READY)
	@command -v mandoc >/dev/null || { echo 'make man: mandoc is missing (Debian: apt-get install mandoc)' >&2; exit 1; }
	@mkdir -p $(OUT)/man
	@for page in man/*.[1-9]; do \
	  mandoc -T lint -W warning "$$page"; \
	  mandoc -T html -O 'man=%N.%S.html' "$$page" >"$(OUT)/man/$$(basename "$$page").html"; \
	done
	@echo 'manual pages as HTML: $(OUT)/man/'

# --- documentation ----------------------------------------------------------------------------------------------------

setup-docs: $(READY)
	@.ci/setup-docs '$(VENV)'

docs: setup-docs
	$(BIN)/python examples/site/assemble.py $(OUT)/site-source
	$(BIN)/python examples/methods/figures.py $(OUT)/site-source/examples/methods
	@rm -rf '$(OUT)/site'
	$(BIN)/sphinx-build -q -W --keep-going -E -c examples/site $(OUT)/site-source $(OUT)/site
	$(BIN)/python examples/site/check_links.py $(OUT)/site
	@echo 'the site: $(OUT)/site/index.html'

tutorial: $(OUT)/s1/metrics.jsonl
	$(BIN)/python tests/documented.py --s1 $(<D) examples/tutorial/[01]*.md examples/how-to/[a-z]*.md

# --- benchmarks -------------------------------------------------------------------------------------------------------

setup-bench: $(READY)
	@test -x .venv-bench/bin/python || $(PYTHON) -m venv .venv-bench
	.venv-bench/bin/pip install -q -e '.[plot,jpda]' pyroomacoustics rir-generator sofar pystoi

BENCH_PYTHON = $(BIN)/python
bench-tracking: BENCH_PYTHON = $(if $(wildcard .venv-bench/bin/python),.venv-bench/bin/python,$(BIN)/python)

$(BENCHES:%=bench-%): bench-%: $(READY)
	@mkdir -p bench-out
	$(BENCH_PYTHON) tests/bench/bench_$(subst -,_,$*).py --out bench-out $(BENCH_FLAGS)

bench: $(READY)
	$(BIN)/python tests/bench/bench_whole.py --out $(OUT)/bench $(BENCH_FLAGS)

stress: $(READY)
	$(BIN)/python tests/bench/stress.py --out $(OUT)/stress $(STRESS_FLAGS)

thesis study: %: $(READY)
	$(BIN)/python tests/bench/$*.py --out $(OUT)/$* $($(if $(filter thesis,$*),THESIS,STUDY)_FLAGS)

$(FITS:%=fit-%): fit-%: $(READY)
	$(BIN)/python tests/bench/fit_$*.py $(FIT_FLAGS)

# --- data sets --------------------------------------------------------------------------------------------------------

datasets: $(READY)
	$(BIN)/python examples/datasets/build.py '$(OUT)/datasets' $(DATASETS_FLAGS)

# --- tidying ----------------------------------------------------------------------------------------------------------

clean:
	rm -rf '$(OUT)' bench-out

distclean: clean
	rm -rf '$(VENV)' .venv-bench
