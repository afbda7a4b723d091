"""What the server of workers does when it starts: it leaves signals to the run, and imports.

A terminal or a cluster signals all processes. The server must outlive its workers, which save their
work first: their parent learns from it how they ended.
"""

from __future__ import annotations

import importlib
import os
import signal
from contextlib import suppress

from torchrl_bmrl.run.forked import FOR_THE_RUN, IMPORTS

for _number in FOR_THE_RUN:
    signal.signal(_number, signal.SIG_IGN)
signal.pthread_sigmask(signal.SIG_UNBLOCK, FOR_THE_RUN)
# Until a worker has its own handler, its parent can end it.
os.register_at_fork(after_in_child=lambda: signal.signal(signal.SIGTERM, signal.SIG_DFL))
for _name in os.environ.pop(IMPORTS, "").split():
    with suppress(Exception):  # a worker that needs the module raises the error
        importlib.import_module(_name)
