"""Recording sets by simulators of third parties, and what the diagnosis says of them.

`camera.py`: the drawn camera and its session; `models.py`: what a simulator does to a frame; `pyxel_models.py` and
`galsim_models.py`: the simulators; `experiment.py`: sets drawn, checked, diagnosed, scored.
"""
