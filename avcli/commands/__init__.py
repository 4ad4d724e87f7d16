"""The eight commands: the only place that knows click, streams and exit codes."""

import _signal as signal  # type: ignore[import-not-found]  # what lies under signal, whose own import can be interrupted
import os
import sys

# Our matrices are small: threads of BLAS wait for each other in busy loops, and in a pipe take the other filters' time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Ctrl-C while a command is still loading its libraries ends it as it ends `cat`, without a traceback of the imports.
_module = os.path.basename(sys.argv[0]).replace("-", "_") + ".py"
if os.path.exists(os.path.join(__path__[0], _module)) and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)
