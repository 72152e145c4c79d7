"""What the effects that bend the wavefront share: path errors over the pupil add up before the pupil makes an image."""

from __future__ import annotations

from abc import abstractmethod

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.optics.pupil import ComplexArray, Wavefront, pupil_ratio
from sim.spectrum import FloatArray


class Aberration(Effect):
    """An effect that is a path error over the lens's pupil; `transfer` is what it makes of a perfect lens alone.

    Several aberrations of one camera (and those of its `Lens.imaging`) act as the sum of their path errors: `sim.forward`
    adds them up. A product of their `transfer` would be another lens: defocus can make up for spherical aberration.
    """

    @abstractmethod
    def wavefront(self, wavelength_nm: float, camera: CameraModel) -> Wavefront:
        """The path error in um; without terms where the effect is absent."""

    def transfer(
        self, fx_cy_per_um: FloatArray, fy_cy_per_um: FloatArray, wavelength_nm: float, camera: CameraModel
    ) -> FloatArray | ComplexArray | None:
        path = self.wavefront(wavelength_nm, camera)
        if not path.terms:
            return None
        return pupil_ratio(fx_cy_per_um, fy_cy_per_um, wavelength_nm, camera.lens.f_number, path)
