"""The engines that diagnose, and which one does where none is asked for."""

from __future__ import annotations

from typing import Literal

#: `evidence`: one table of sets of effects with their posterior probabilities (`lab.inference`). `today`: odds with
#: their gates (`lab.diagnose.inference`).
Engine = Literal["evidence", "today"]
DEFAULT_ENGINE: Engine = "today"
