"""Workers that misbehave; in a module of their own, since spawned processes import them."""

import os
import time

from rsa_vision.batch import Outcome, Task
from rsa_vision.errors import UsageError
from rsa_vision.tables import failed_rows


def misbehave(task: Task) -> Outcome:
    """Do what the name of the examination says."""
    exam = task.files.exam
    if exam == "die":
        os._exit(7)
    if exam == "hang":
        time.sleep(60)
    if exam == "raise":
        raise ValueError("unforeseen")
    if exam == "full":
        raise UsageError("no room")
    rows = failed_rows(task.files.subject, exam, [], "cage-not-found", os.environ.get("OMP_NUM_THREADS", ""))
    return Outcome(task.files.subject, exam, rows)
