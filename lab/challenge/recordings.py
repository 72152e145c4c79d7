"""Sessions of the second image former as recording sets."""

from __future__ import annotations

from lab.formats.recording_set import Manifest, RecordingSet
from mocks.former import WAVELENGTH_NM, WHOLE_SESSION, ConcealedCamera, DrawnSession, Plan, record, record_pair
from sim.spectrum import Spectrum


def recordings_of(camera: ConcealedCamera, plan: Plan = WHOLE_SESSION) -> RecordingSet:
    """Return the recording set of one camera."""
    return recording_set(record(camera, plan))


def recordings_of_pair(left: ConcealedCamera, right: ConcealedCamera, plan: Plan) -> RecordingSet:
    """Return the recording set of a stereo pair."""
    return recording_set(record_pair(left, right, plan))


def recording_set(session: DrawnSession) -> RecordingSet:
    """Return the recording set of a session; raises ValidationError where its manifest doesn't follow the format."""
    spectra = {path: Spectrum.of(WAVELENGTH_NM, values) for path, values in session.spectra.items()}
    manifest = Manifest.model_validate(session.manifest)
    # every field is written, null where it is unknown
    manifest = Manifest.model_validate(manifest.model_dump(mode="json"))
    return RecordingSet(manifest, dict(session.frames), spectra, dict(session.targets), source=manifest.name)
