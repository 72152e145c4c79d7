"""Laws of the charge: collection, neighbours, dark current, and what one frame leaves to the next."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import convolve

from evaluation.independent_simulator.law import DARK, OPTICAL, Array, CameraProperties, Law


class ChargeDiffusionLaw(Law):
    """Lateral diffusion, a Gaussian. Variants: independent of the wavelength; growing with its square; by absorption
    depth in silicon (Stevens 1992)."""

    name = effect = "charge_diffusion"
    variants, unit, nominal, limits, power, shown_by = 3, "um", 0.7, (0.1, 2.5), 2.0, OPTICAL

    def spectral_transfer(self, frequency_cy_um: Array, wavelength_um: float) -> Array:
        d = self.strength
        if self.variant < 2:
            d = d * (1.0 if self.variant == 0 else (wavelength_um / 0.55) ** 2)
            return np.exp(-2 * (np.pi * d * frequency_cy_um) ** 2)
        depth, alpha = 4.0, 1 / (0.13 * (wavelength_um / 0.4) ** 5.5)
        z = (np.arange(30) + 0.5) / 30 * depth
        p = np.exp(-alpha * z)
        spread = (1.6 * d) ** 2 * z / depth
        return (
            np.tensordot(p, np.exp(-2 * np.pi**2 * np.multiply.outer(spread, np.square(frequency_cy_um))), 1) / p.sum()
        )

    def library_parameters(self) -> dict[str, float]:
        return {"length_um": self.strength} if self.variant < 2 else {}


class CrosstalkLaw(Law):
    """Photocharge shared with neighbours. Variants: the four nearest; all eight; more along rows."""

    name = effect = "crosstalk"
    variants, unit, nominal, limits, shown_by = 3, "%", 0.8, (0.02, 5.0), frozenset({"slanted_edge", "narrowband"})

    def collected_e(self, electrons: Array, rate_e_per_s: Array) -> Array:
        c, d = self.strength / 100.0, 0.25 * self.strength / 100.0 if self.variant == 1 else 0.0
        h = c * (1.5 if self.variant == 2 else 1.0)
        kernel = np.array([[d, c, d], [h, 1 - 2 * c - 2 * h - 4 * d, h], [d, c, d]])
        return convolve(electrons, kernel, mode="mirror")

    def library_parameters(self) -> dict[str, float]:
        return {"share_percent": self.strength} if self.variant == 0 else {}


class InterPixelCapacitanceLaw(Law):
    """Neighbours are coupled after the charge was collected, so that noise is shared, too (related to crosstalk).
    Variants: the four next alike; those in the row twice as much as those in the column, and a fifth of their mean
    across corners."""

    name, variants, unit, nominal, limits = "inter_pixel_capacitance", 2, "%", 0.8, (0.02, 6.0)
    families = frozenset({"charge_between_neighbours"})
    accepts = frozenset({"crosstalk", "inter_pixel_capacitance"})

    def drawn_e(self, electrons: Array, mean_e: Array) -> Array:
        c = self.strength / 100
        if self.variant == 1:
            a, d, q = 4.0 * c / 3.0, 2.0 * c / 3.0, 0.2 * c
            return convolve(electrons, np.array([[q, d, q], [a, 1 - 4.8 * c, a], [q, d, q]]), mode="mirror")
        return convolve(electrons, np.array([[0, c, 0], [c, 1 - 4 * c, c], [0, c, 0]]), mode="mirror")


class BrighterFatterLaw(Law):
    """Charge repels charge. Variants: the variance falls with the signal; neighbours receive what is repelled
    (Antilogus 2014); every border between two pixels moves in proportion to the difference of their charges, so that
    means of unequal neighbours move, too; thick silicon, where neighbours across corners receive 0.35 and second ones
    0.12 of what the next do."""

    name = effect = "brighter_fatter"
    variants, unit, nominal, limits = 4, "%", 4.0, (0.1, 20.0)

    def drawn_e(self, electrons: Array, mean_e: Array) -> Array:
        x = np.clip(mean_e / self.camera.full_well_e, 0, 1)
        away = electrons - mean_e
        if self.variant == 2:  # a pair exchanges a / 2 (e^2 - f^2): alone it would cost 8 a of the variance
            square = np.square(electrons)
            four = convolve(square, np.array([[0, 1, 0], [1, -4, 1], [0, 1, 0]]), mode="mirror")
            return electrons + self.strength / 100.0 / (16.0 * self.camera.full_well_e) * four
        if self.variant == 0:
            return mean_e + away * np.sqrt(1 - self.strength / 100.0 * x)
        if self.variant == 3:
            q, s = 0.35, 0.12
            far = np.array(
                [[0, 0, s, 0, 0], [0, q, 1, q, 0], [s, 1, 0, 1, s], [0, q, 1, q, 0], [0, 0, s, 0, 0]], np.float64
            )
            return (
                mean_e
                + away
                + 0.5 * self.strength / 100.0 * x * (convolve(away, far / far.sum(), mode="mirror") - away)
            )
        around = convolve(away, np.array([[0, 0.25, 0], [0.25, 0, 0.25], [0, 0.25, 0]]), mode="mirror")
        return mean_e + away + 0.5 * self.strength / 100.0 * x * (around - away)

    def library_parameters(self) -> dict[str, float]:
        return {"loss_percent": self.strength} if self.variant == 0 else {}


class AnisotropicBrighterFatterLaw(Law):
    """Charge repels charge, unlike in the two directions, as channel stops hold it along rows and gates along columns
    (Antilogus 2014). Variants: three times as much goes to neighbours in the row; borders move, three times as much
    towards neighbours in the column."""

    name, effect = "anisotropic_brighter_fatter", "brighter_fatter"
    variants, unit, nominal, limits = 2, "%", 6.0, (0.1, 20.0)

    def drawn_e(self, electrons: Array, mean_e: Array) -> Array:
        full, share = self.camera.full_well_e, self.strength / 100.0
        if self.variant == 1:
            turned = np.array([[0.0, 1.5, 0.0], [0.5, -4.0, 0.5], [0.0, 1.5, 0.0]])
            return electrons + share / (16.0 * full) * convolve(np.square(electrons), turned, mode="mirror")
        moved = np.array([[0.0, 0.125, 0.0], [0.375, -1.0, 0.375], [0.0, 0.125, 0.0]])
        filled = np.clip(mean_e / full, 0.0, 1.0)
        return electrons + 0.5 * share * filled * convolve(electrons - mean_e, moved, mode="mirror")

    def library_parameters(self) -> dict[str, float]:
        sizes = {"loss_percent": self.strength, "shared_percent": self.strength}
        return sizes | {"row_excess": 0.5 if self.variant == 0 else -0.5}


class GreenImbalanceLaw(Law):
    """The two greens of a Bayer mosaic differ in response."""

    name = effect = "green_imbalance"
    unit, nominal, limits, needs = "%", 1.0, (0.02, 6.0), "bayer"

    def collected_e(self, electrons: Array, rate_e_per_s: Array) -> Array:
        cfa, out = str(self.camera.cfa), electrons.copy()
        greens = [k for k, c in enumerate(cfa) if c == "G"]
        for k, sign in zip(greens, (1, -1), strict=True):
            out[k // 2 :: 2, k % 2 :: 2] *= 1 + sign * self.strength / 200.0
        return out


class PhaseDetectionRowsLaw(Law):
    """Half-masked pixels for autofocus. Variants: whole rows, all of their pixels alike, every 8; every 12, the colour
    that isn't green alone (mono: all); every 16, pairs of pixels masked left and right, which fall off to opposite
    sides of the field."""

    name = effect = "phase_detection_rows"
    variants, unit, nominal, limits = 3, "%", 4.0, (0.05, 60.0)

    @property
    def _period(self) -> int:
        return (8, 12, 16)[self.variant]

    @property
    def _first(self) -> int:
        return int(self.uniform[2] * self._period)

    def collected_e(self, electrons: Array, rate_e_per_s: Array) -> Array:
        masked = np.zeros(electrons.shape)
        masked[self._first :: self._period] = self.strength / 100.0
        if self.variant == 1 and self.camera.cfa != "MONO":
            green = np.array([c == "G" for c in self.camera.cfa]).reshape(2, 2)
            masked *= ~np.tile(green, (electrons.shape[0] // 2, electrons.shape[1] // 2))
        if self.variant == 2:
            left = 1.0 - 2.0 * (np.arange(electrons.shape[1]) // 2 % 2)
            masked *= 1.0 + 0.4 * left * self.camera.field_position[0]
        return electrons * (1.0 - masked)

    def library_parameters(self) -> dict[str, float]:
        if self.variant == 1 and self.camera.cfa != "MONO":
            return {"loss_percent": 0.5 * self.strength, "colour_percent": self.strength}
        return {"loss_percent": self.strength}


class TapGainLaw(Law):
    """Parts of the sensor are read by amplifiers of other gains, which noise shares. Variants: the right half; four
    strips, each of another; the lower half."""

    name, effect = "tap_gain", "taps"
    variants, unit, nominal, limits = 3, "%", 1.0, (0.02, 8.0)

    def response(self, electrons: Array) -> Array:
        rows, cols = electrons.shape
        strips = 4 if self.variant == 1 else 2
        tap = 2 * np.arange(rows)[:, None] // rows if self.variant == 2 else strips * np.arange(cols) // cols
        change = (0.0, 1.0, -0.5, 0.7) if self.variant == 1 else (0.0, 1.0)
        return electrons * (1.0 + self.strength / 100.0 * np.array(change)[tap])

    def library_parameters(self) -> dict[str, float]:
        return {} if self.variant == 1 else {"gain_percent": self.strength}


class TreeRingsLaw(Law):
    """Rings of doping in the wafer: the response oscillates with the distance from a centre outside the frame."""

    name, unit, nominal, limits = "tree_rings", "%", 1.0, (0.02, 10.0)
    families = frozenset({"field_of_light"})

    def relative_response(self, x: Array, y: Array) -> Array:
        return 1 + self.strength / 100 * np.cos(
            2 * np.pi * (1.5 + 2.0 * self.uniform[0]) * np.hypot(x + 1.2, y + 0.9) ** 1.5
        )


class ResponseTailLaw(Law):
    """2 % of the pixels have a lower response, lognormal: dust on the sensor."""

    name, unit, nominal, limits = "response_tail", "%", 2.0, (0.05, 20.0)
    families = frozenset({"defective_pixels"})

    def relative_response(self, x: Array, y: Array) -> Array:
        return 1 - np.where(
            self.rng(9).random(np.shape(x)) < 0.02, self.strength / 100 * self.rng(10).lognormal(0, 0.7, np.shape(x)), 0
        )


class ExposureOffsetLaw(Law):
    """Light is collected longer than requested."""

    name = effect = "exposure_offset"
    variants, unit, nominal, limits = 1, "us", 30.0, (0.2, 2000.0)

    def collection_time_s(self, exposure_s: float) -> float:
        return exposure_s + self.strength * 1e-6

    def library_parameters(self) -> dict[str, float]:
        return {"offset_us": self.strength}


class LeakyShutterLaw(Law):
    """Light is still collected while rows wait for read-out, longer the later the row. Variants: read from the top;
    from the bottom; from the top, in bursts of eight rows."""

    name, effect = "leaky_shutter", "shutter_leakage"
    variants, unit, nominal, limits = 3, "us", 60.0, (0.5, 5000.0)

    def collected_e(self, electrons: Array, rate_e_per_s: Array) -> Array:
        waits = np.arange(len(electrons)) / len(electrons)
        if self.variant == 1:
            waits = waits[::-1]
        if self.variant == 2:
            waits = np.floor(waits * len(electrons) / 8.0) * 8.0 / len(electrons)
        return electrons + rate_e_per_s * self.strength * 1e-6 * waits[:, None]

    def library_parameters(self) -> dict[str, float]:
        return {"last_row_us": self.strength}


class SmearLaw(Law):
    """Charge is shifted through the light: each column receives a share of its own mean."""

    name, unit, nominal, limits = "smear", "%", 0.5, (0.01, 5.0)
    families = frozenset({"charge_between_neighbours", "copies_and_veils"})
    shown_by = frozenset({"chart", "checkerboard"})

    def collected_e(self, electrons: Array, rate_e_per_s: Array) -> Array:
        return electrons + self.strength / 100 * electrons.mean(0, keepdims=True)


class ImageLagLaw(Law):
    """Charge of the previous frame that comes with this one. Variants: a constant share; a share that grows with the
    charge to the power of 0.3."""

    name = effect = "image_lag"
    variants, unit, nominal, limits, shown_by = 2, "%", 0.5, (0.01, 5.0), frozenset({"dark", "flat"})

    def lag_e(self, previous_e: Array | None) -> Array:
        if previous_e is None:
            return 0.0
        share = self.strength / 100.0
        return (
            share * previous_e
            if self.variant == 0
            else share * previous_e * (previous_e / self.camera.full_well_e).clip(0, 1) ** 0.3
        )

    def library_parameters(self) -> dict[str, float]:
        return {"lag_percent": self.strength} if self.variant == 0 else {}


class PersistenceLaw(Law):
    """Traps fill with a share of a frame's charge and empty slowly; the pixels are reset when an exposure begins.
    Variants: one kind, of 30 s; two kinds of half the strength, of 12 and 120 s; one of 30 s that is full at a third of
    the well (its filling saturates exponentially)."""

    name = effect = "persistence"
    variants, unit, nominal, limits, shown_by = 3, "%", 1.0, (0.01, 20.0), DARK

    def bind(self, camera: CameraProperties) -> None:
        super().bind(camera)
        #: Occupied traps (rows, cols) of each kind, when the last exposure ended (s).
        self._occupied: list[Array] = [0.0, 0.0]
        self._ended_s = 0.0

    def lag_e(self, previous_e: Array | None) -> Array:
        begins_s, total = self.frame.elapsed_s, 0.0
        for kind, tau_s in enumerate((12.0, 120.0) if self.variant == 1 else (30.0,)):
            if previous_e is not None:
                full, share = self.camera.full_well_e, self.strength / 100.0 / (1 + (self.variant == 1))
                level = np.minimum(previous_e, full)
                if self.variant == 2:
                    level = full / 3.0 * (1.0 - np.exp(-3.0 * level / full))
                self._occupied[kind] = self._occupied[kind] + share * level
            waits_s = begins_s - self._ended_s
            begin = self._occupied[kind] * np.exp(-waits_s / tau_s)
            self._occupied[kind] = begin * np.exp(-self.frame.exposure_s / tau_s)
            total = total + begin - self._occupied[kind]
        self._ended_s = begins_s + self.frame.exposure_s
        return total

    def library_parameters(self) -> dict[str, float]:
        return {"share_percent": self.strength, "release_s": 30.0} if self.variant == 0 else {}


class ChargeTransferLaw(Law):
    """Packets of a CCD leave charge behind at every transfer, clocked one by one. Variants: rows, read from the top,
    and traps that release by exp(-t / 0.8); columns, read from the right, exp(-t / 3); rows, and faint packets lose
    more, as (x / W)^0.6 in place of x. Strength: loss of a full packet by one transfer, in 1e-6. Traps take electrons
    one by one, so that shot noise isn't shared: it is of what arrives."""

    name = effect = "charge_transfer_inefficiency"
    variants, unit, nominal, limits, shown_by = 3, "1e-6", 60.0, (2.0, 900.0), OPTICAL

    def collected_e(self, electrons: Array, rate_e_per_s: Array) -> Array:
        packets = np.array(electrons[:, ::-1].T if self.variant == 1 else electrons, float)
        full = self.camera.full_well_e
        kept = np.exp(-1.0 / (3.0 if self.variant == 1 else 0.8))
        lines = len(packets)
        # pixels in groups of eight, that share their traps' state: what each transfer takes is small
        for first in range(lines - lines % 8, -1, -8):
            many = 1e-6 * self.strength * np.minimum(np.arange(lines - first) + 1.0, 8.0)
            held = np.zeros(packets.shape[1])
            for number, row in enumerate(range(first, lines)):
                packet = packets[row]
                powered = full * (packet / full).clip(0.0, None) ** 0.6 if self.variant == 2 else packet
                taken = np.minimum(many[number] * powered, packet)
                released = (1.0 - kept) * held
                packets[row] = packet - taken + released
                held = held + taken - released
        return packets.T[:, ::-1] if self.variant == 1 else packets

    def library_parameters(self) -> dict[str, float]:
        if self.variant == 1:
            return {"serial_ppm": self.strength, "serial_release_px": 3.0}
        return {"parallel_ppm": self.strength, "release_px": 0.8} if self.variant == 0 else {}


class ExcessNoiseLaw(Law):
    """Electrons are multiplied at random before read-out; codes are of the mean electron. Variants: a register of 24
    stages, each of which adds an electron with the same small probability (Robbins and Hadwen 2003); a geometric
    number of electrons for each. Strength: variance beyond that of single electrons."""

    name = effect = "excess_noise"
    variants, unit, nominal, limits = 2, "%", 60.0, (2.0, 85.0)

    def drawn_e(self, electrons: Array, mean_e: Array) -> Array:
        rng, more = self.rng(21, self.frame.draw), self.strength / 100.0
        number = np.maximum(np.rint(electrons), 0.0)
        if self.variant == 1:  # F^2 = 2 - 1 / M
            chance = 1.0 - more
            further = rng.negative_binomial(np.maximum(number, 1.0), chance)
            return np.where(number > 0, (number + further) * chance, electrons)
        stages, gains = 24, np.linspace(1.0001, 200.0, 400_000)
        factor = 2.0 * (gains - 1.0) * gains ** (-(stages + 1.0) / stages) + 1.0 / gains
        gain = float(gains[np.searchsorted(np.maximum.accumulate(factor), 1.0 + more)])
        chance, packet = gain ** (1.0 / stages) - 1.0, number.astype(np.int64)
        for _ in range(stages):
            packet = packet + rng.binomial(packet, chance)
        return packet / gain

    def library_parameters(self) -> dict[str, float]:
        return {"excess_percent": self.strength}


class CosmicRaysLaw(Law):
    """Single particles in the silicon. Variants: muons through 10 um, at cos^2 of the zenith angle, with a long tail of
    losses; points of 1620 electrons (iron-55); muons through 100 um."""

    name = effect = "cosmic_rays"
    variants, unit, nominal, limits, shown_by = 3, "1/(cm2 s)", 600.0, (10.0, 30000.0), DARK

    def noise_e(self, shape: tuple[int, int], k: int) -> Array:
        rng, pitch = self.rng(22, k), self.camera.pitch_um
        area_cm2 = shape[0] * shape[1] * pitch**2 * 1e-8
        frame = np.zeros(shape)
        for _ in range(rng.poisson(self.strength * area_cm2 * self.frame.exposure_s)):
            row, col = rng.uniform(0, shape[0]), rng.uniform(0, shape[1])
            if self.variant == 1:
                frame[int(row), int(col)] += rng.normal(1620.0, 15.0)
                continue
            depth, angle = (100.0 if self.variant == 2 else 10.0), rng.uniform(0.0, 2.0 * np.pi)
            slope = np.sqrt(max((1.0 - rng.random()) ** -0.5 - 1.0, 0.0))  # tan of an angle of density cos^3 sin
            slope = min(slope, 20.0)
            loss_e = 80.0 * depth * np.hypot(1.0, slope) * (1.0 + 0.3 * rng.exponential())
            steps = max(int(2.0 * depth * slope / pitch), 1)
            for part in (np.arange(steps) + 0.5) / steps * depth * slope / pitch:
                r, c = int(np.floor(row + part * np.sin(angle))), int(np.floor(col + part * np.cos(angle)))
                if 0 <= r < shape[0] and 0 <= c < shape[1]:
                    frame[r, c] += loss_e / steps
        return frame

    def library_parameters(self) -> dict[str, float]:
        return {"rate_per_cm2_s": self.strength}


class DarkCurrentTemperatureLaw(Law):
    """Dark current that rises with the temperature. Variants: exponential; Arrhenius. Strength: doublings in 10
    degrees."""

    name = effect = "dark_current_temperature"
    variants, unit, nominal, limits, needs, shown_by = 2, "1/(10 C)", 1.3, (0.02, 3.0), "temperature", DARK

    def dark_rate(self, rate_e_per_s: Array, temperature_c: float) -> Array:
        if self.variant == 0:
            return rate_e_per_s * 2.0 ** (self.strength * (temperature_c - 25.0) / 10.0)
        slope = self.strength * np.log(2.0) / 10.0 * 298.15**2
        return rate_e_per_s * np.exp(slope * (1 / 298.15 - 1 / (273.15 + temperature_c)))

    def library_parameters(self) -> dict[str, float]:
        return {"doublings_per_c": self.strength / 10.0} if self.variant == 0 else {}


class AmplifierGlowLaw(Law):
    """Light of the output amplifier near a corner. Variants: exponential; Lorentzian."""

    name = effect = "amplifier_glow"
    variants, unit, nominal, limits, shown_by = 2, "e/s", 20.0, (0.2, 400.0), DARK

    def dark_rate(self, rate_e_per_s: Array, temperature_c: float) -> Array:
        x, y = self.camera.field_position
        r = np.hypot(x - np.sign(self.uniform[0] - 0.5) * 0.8, y - np.sign(self.uniform[1] - 0.5) * 0.6)
        return rate_e_per_s + self.strength * (np.exp(-r / 0.3) if self.variant == 0 else 1 / (1 + (r / 0.2) ** 2))


class HotPixelsLaw(Law):
    """A few pixels of high dark current. Variants: all equal; lognormal; exponential."""

    name = effect = "hot_pixels"
    variants, unit, nominal, limits, shown_by = 3, "e/s", 150.0, (5.0, 3000.0), DARK

    def dark_rate(self, rate_e_per_s: Array, temperature_c: float) -> Array:
        rng = self.rng(1)
        hot = rng.random((self.camera.rows, self.camera.cols)) < 5e-4
        hot[self.camera.rows // 3, self.camera.cols // 3] = True  # one at least
        size: Array = 1.0
        if self.variant:
            size = rng.lognormal(-0.3, 0.8, hot.shape) if self.variant == 1 else rng.exponential(1.0, hot.shape)
        return rate_e_per_s + np.where(hot, self.strength * size, 0.0)


class LightLeakLaw(Law):
    """Light passes the lens cap, most of it about one position inside the frame (related to amplifier glow)."""

    name, unit, nominal, limits, shown_by = "light_leak", "e/s", 5.0, (0.05, 400.0), DARK
    families = frozenset({"dark_signal"})

    def dark_rate(self, rate_e_per_s: Array, temperature_c: float) -> Array:
        x, y = self.camera.field_position
        r2 = (x - 0.8 * (self.uniform[0] - 0.5)) ** 2 + (y - 0.6 * (self.uniform[1] - 0.5)) ** 2
        return rate_e_per_s + self.strength * np.exp(-0.5 * r2 / 0.3**2)
