"""What is stated of a camera and of its captures, as hypotheses: each statement may be wrong.

statement.py    what a statement declares, and the list of all
exposure.py     the exposure of one setting
black_level.py  the black level
lights.py       two lights under each other's captures
found.py        those that a table says are wrong, in words
structure.py    statements that decide what can be measured at all: units, bits, colours, kinds, frames, boards

A wrong statement of the first three changes predictions and no number: these are hypotheses of the table of sets,
beside the effects. Those of `structure.py` are weighed before anything is measured, each by numbers of its own, which
no effect predicts: given these, their odds are independent of the table.
"""
