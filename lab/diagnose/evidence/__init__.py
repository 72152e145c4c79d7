"""What the table of sets says, as the result of a diagnosis: `calibench diagnose --engine evidence`.

side_table.py  one side: the table, and the models about which it is read
causes.py      inclusion probabilities, sizes, rivals
places.py      where recordings depart from the empty set; goodness of fit, curves, smallest detectable magnitudes
laws.py        what is unlisted, as curves
improved.py    the camera with what is named, its posterior, and its rivals for a prediction
doubt.py       the sets that remain, and the captures that would separate them
side.py        all of it for one side
merge.py       the sides as one result

It reads what `lab.inference` returns, and decides nothing besides.
"""
