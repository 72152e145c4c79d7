"""Laws of the read-out: amplifier, converter, offsets and noise patterns, digital processing."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from scipy.ndimage import convolve, shift
from scipy.signal import lfilter

from evaluation.independent_simulator.law import DARK, OPTICAL, Array, Law


class NonlinearityLaw(Law):
    """The response bends. Variants: quadratic; hyperbolic tangent; power law."""

    name = effect = "nonlinearity"
    variants, unit, nominal, limits = 3, "%", 1.5, (0.01, 8.0)

    def response(self, electrons: Array) -> Array:
        a, x = self.strength / 100.0, electrons / self.camera.full_well_e
        if self.variant == 0:
            return electrons * (1 - a * x)
        if self.variant == 1:
            k = np.sqrt(3 * a)
            return np.where(x > 0, self.camera.full_well_e * np.tanh(k * x) / k, electrons)
        return electrons * np.clip(x, 1e-6, None) ** (-0.4 * a)

    def library_parameters(self) -> dict[str, float]:
        return {"quadratic_percent": -self.strength} if self.variant == 0 else {}


class ResponseKneeLaw(Law):
    """The slope is smaller above a level between 0.3 and 0.6 of full well. Variants: a sharp knee; one that is rounded
    over 3 % of full well; two knees of half the change, 0.2 of full well apart."""

    name = effect = "response_knee"
    variants, unit, nominal, limits = 3, "%", 3.0, (0.05, 20.0)

    @property
    def knee_share(self) -> float:
        """The level over full well."""
        return 0.3 + 0.3 * float(self.uniform[0])

    def response(self, electrons: Array) -> Array:
        full = self.camera.full_well_e
        over = electrons / full - self.knee_share
        if self.variant == 0:
            over = np.where(over > 0, over, 0.0)
        elif self.variant == 1:
            over = 0.03 * np.logaddexp(0.0, over / 0.03)
        else:
            over = 0.5 * (np.clip(over, 0, None) + np.clip(over - 0.2, 0, None))
        return electrons - self.strength / 100.0 * full * over

    def library_parameters(self) -> dict[str, float]:
        return {"slope_percent": -self.strength, "knee_share": self.knee_share} if self.variant == 0 else {}


class BitWeightsLaw(Law):
    """Successive approximation with lowest bits of wrong weight. Variants: of the two lowest; a table of four unequal
    widths, as of a last stage of two bits; of the third-lowest only. Strength: the largest error of a weight, or
    departure of a width."""

    name = effect = "bit_weights"
    variants, unit, nominal, limits, signed = 3, "DN", 0.25, (0.01, 0.95), True

    @property
    def _errors(self) -> tuple[float, float, float]:
        """Of the weights of the lowest bit, the next, and the one after that."""
        e = self.signed_strength
        return (e, -0.5 * e, 0.0) if self.variant == 0 else (0.0, 0.0, e)

    def adc_output(self, dn: Array) -> Array:
        left = np.clip(dn + 0.5, 0.0, None)
        code = np.zeros_like(left)
        if self.variant == 1:
            away = self.rng(14).uniform(-1.0, 1.0, 4)
            away -= away.mean()
            begins = np.append(0.0, np.cumsum(1.0 + self.strength * away / np.abs(away).max())[:3])
            return 4.0 * (left // 4.0) + np.searchsorted(begins, left % 4.0, side="right") - 1.0
        for bit in reversed(range(16)):
            weight = 2.0**bit + (self._errors[bit] if bit < 3 else 0.0)
            taken = left >= weight
            left, code = np.where(taken, left - weight, left), code + 2.0**bit * taken
        return code

    def library_parameters(self) -> dict[str, float]:
        last, second, third = self._errors
        return {} if self.variant == 1 else {"last_dn": last, "second_dn": second, "third_dn": third}


class AdcNonlinearityLaw(Law):
    """The converter's steps are unequal. Variants: the weight of the highest bit; of the two highest; a sine over an
    eighth of the codes (integral nonlinearity of a folding converter); a saw tooth of a quarter of them (the second
    stage of a pipeline has another gain); a step at a code that is no power of two (a comparator of a flash stage).
    Strength in codes of 12 bit."""

    name = effect = "adc_nonlinearity"
    variants, unit, nominal, limits, signed = 5, "DN", 3.0, (0.05, 20.0), True

    @property
    def listed_effect(self) -> str | None:
        return {2: "adc_ripple", 4: "adc_step"}.get(self.variant, self.effect)

    def adc_output(self, dn: Array) -> Array:
        full = self.camera.full_code_dn + 1.0
        error, share = self.signed_strength * full / 4096.0, dn / full
        if self.variant == 2:
            return dn + error * np.sin(2 * np.pi * (8.0 * share + self.uniform[0]))
        if self.variant == 3:
            return dn + error * (4.0 * share % 1.0 - 0.5)
        if self.variant == 4:
            return dn + error * (share >= 0.15 + 0.6 * self.uniform[1])
        out = dn + error * (share >= 0.5)
        return out + (0.5 * error * (share % 0.5 >= 0.25) if self.variant == 1 else 0.0)


class DigitalGainLaw(Law):
    """Codes are multiplied after the converter: some occur twice as often or never (related to ADC nonlinearity)."""

    name, unit, nominal, limits = "digital_gain", "%", 10.0, (1.0, 60.0)
    families = frozenset({"converter"})

    def processed_dn(self, dn: Array) -> Array:
        black = self.camera.black_level_dn
        return np.floor(black + (np.round(dn) - black) * (1 + self.strength / 100))


class LossyCodesLaw(Law):
    """Codes are quantised in equal steps of their square root, as by lossy compression."""

    name, unit, nominal, limits = "lossy_codes", "1", 0.05, (0.003, 0.5)
    families = frozenset({"converter"})

    def processed_dn(self, dn: Array) -> Array:
        return np.square(np.round(np.sqrt(np.clip(dn, 0, None)) / self.strength) * self.strength)


class BlackLevelDriftLaw(Law):
    """The black level moves with the time. Variants: linearly; exponentially towards a final value."""

    name = effect = "black_level_drift"
    variants, unit, nominal, limits, signed, shown_by = 2, "DN/min", 0.05, (0.002, 2.0), True, DARK

    def offset_dn(self, elapsed_s: float, temperature_c: float) -> float:
        minutes = elapsed_s / 60.0
        return self.signed_strength * (minutes if self.variant == 0 else 10.0 * (1 - np.exp(-minutes / 10.0)))

    def library_parameters(self) -> dict[str, float]:
        return {"drift_dn_per_min": self.signed_strength} if self.variant == 0 else {}


class BlackLevelTemperatureLaw(Law):
    """The black level follows the sensor's temperature."""

    name, effect = "black_level_temperature", "black_level_drift"
    unit, nominal, limits, signed, needs, shown_by = "DN/C", 0.2, (0.002, 5.0), True, "temperature", DARK

    def offset_dn(self, elapsed_s: float, temperature_c: float) -> float:
        return self.signed_strength * (temperature_c - 25.0)

    def library_parameters(self) -> dict[str, float]:
        return {"drift_dn_per_c": self.signed_strength}


class TapOffsetLaw(Law):
    """Parts of the sensor are read by amplifiers of other black levels. Variants: the right half; four strips."""

    name, effect = "tap_offset", "taps"
    variants, unit, nominal, limits, shown_by = 2, "e", 1.0, (0.02, 30.0), DARK

    def noise_e(self, shape: tuple[int, int], k: int) -> Array:
        tap = (4 if self.variant == 1 else 2) * np.arange(shape[1]) // shape[1]
        level = np.array((0.0, 1.0, -0.5, 0.7) if self.variant == 1 else (0.0, 1.0))[tap]
        return self.strength * np.broadcast_to(level, shape)

    def library_parameters(self) -> dict[str, float]:
        return {} if self.variant == 1 else {"offset_e": self.strength}


class AmplifierCrosstalkLaw(Law):
    """Ports that read parts of the frame at once disturb each other. Variants: two halves, read from the outer sides
    inwards; four strips alike, where the next disturb and the others hardly do; the right half takes from the left one
    alone."""

    name = effect = "amplifier_crosstalk"
    variants, unit, nominal, limits, needs = 3, "%", 1.0, (0.02, 15.0), "mono"

    def response(self, electrons: Array) -> Array:
        c, out, cols = self.strength / 100.0, np.array(electrons, np.float64), electrons.shape[1]
        if self.variant == 1:
            wide = cols // 4
            strips = [electrons[:, k * wide : (k + 1) * wide] for k in range(4)]
            for k in range(4):
                for j in range(4):
                    if j != k:
                        out[:, k * wide : (k + 1) * wide] += c * (1.0 if abs(j - k) == 1 else 0.3) * strips[j]
            return out
        half = cols // 2
        left, right = electrons[:, :half], electrons[:, half : 2 * half]
        if self.variant == 2:
            out[:, half : 2 * half] += 2.0 * c * left
            return out
        out[:, :half] += c * right[:, ::-1]
        out[:, half : 2 * half] += c * left[:, ::-1]
        return out

    def library_parameters(self) -> dict[str, float]:
        return {
            0: {"share_percent": self.strength},
            2: {"share_percent": self.strength, "excess_percent": self.strength},
        }.get(self.variant, {})


class LineGainLaw(Law):
    """Each line has an amplifier, or a slope of its converter, of its own. Variants: columns, normal; columns, uniform;
    rows."""

    name, effect = "line_gain", "column_gain"
    variants, unit, nominal, limits = 3, "%", 0.6, (0.02, 6.0)

    @property
    def listed_effect(self) -> str | None:
        return "row_gain" if self.variant == 2 else self.effect

    def response(self, electrons: Array) -> Array:
        rows, cols = electrons.shape
        still = self.rng(21)
        if self.variant == 1:
            away = np.sqrt(3.0) * still.uniform(-1.0, 1.0, cols)
        else:
            away = still.standard_normal(rows if self.variant == 2 else cols)
        away = 1.0 + self.strength / 100.0 * (away - away.mean())
        return electrons * (away[:, None] if self.variant == 2 else away)

    def library_parameters(self) -> dict[str, float]:
        return {"gain_percent": self.strength}


class RowNoiseLaw(Law):
    """A temporal offset of each row. Variants: white; correlated between neighbouring rows."""

    name = effect = "row_noise"
    variants, unit, nominal, limits, power, shown_by = 2, "e", 2.0, (0.1, 30.0), 2.0, DARK

    def noise_e(self, shape: tuple[int, int], k: int) -> Array:
        white = self.rng(2, k).standard_normal(shape[0])
        if self.variant == 1:
            for i in range(1, len(white)):
                white[i] = 0.6 * white[i - 1] + 0.8 * white[i]
        return self.strength * white[:, None]

    def library_parameters(self) -> dict[str, float]:
        return {"noise_e": self.strength}


class AlternatingRowNoiseLaw(Law):
    """Two amplifiers, of even and of odd columns, are clamped anew before every row, each at a level of its own."""

    name = effect = "alternating_row_noise"
    unit, nominal, limits, power, shown_by = "e", 1.5, (0.1, 30.0), 2.0, DARK

    def noise_e(self, shape: tuple[int, int], k: int) -> Array:
        level = self.rng(23, k).standard_normal((2, shape[0], 1))
        return self.strength * np.where(np.arange(shape[1]) % 2 == 0, level[0], level[1])

    def library_parameters(self) -> dict[str, float]:
        return {"noise_e": self.strength}


class ColouredLineNoiseLaw(Law):
    """Noise of lines by fluctuators of many time constants, the sum of which has a spectrum of about 1/f (Machlup
    1954). Variants: rows; columns; rows, the slow fluctuators twice as strong in power (steeper)."""

    name = effect = "coloured_line_noise"
    variants, unit, nominal, limits, power, shown_by = 3, "e", 3.0, (0.2, 40.0), 2.0, DARK

    def noise_e(self, shape: tuple[int, int], k: int) -> Array:
        count = shape[1] if self.variant == 1 else shape[0]
        rng, total, whole = self.rng(15, k), np.zeros(count), 0.0
        for octave in range(8):  # correlated over 0.5, 1, 2, ... 64 lines
            keep, weight = np.exp(-(2.0 ** (1 - octave))), 2.0**octave if self.variant == 2 else 1.0
            white = rng.standard_normal(count)
            wave = np.empty(count)
            wave[0] = white[0]
            for i in range(1, count):
                wave[i] = keep * wave[i - 1] + np.sqrt(1.0 - keep * keep) * white[i]
            total, whole = total + np.sqrt(weight) * wave, whole + weight
        noise = self.strength * total / np.sqrt(whole)
        return np.broadcast_to(noise[None, :] if self.variant == 1 else noise[:, None], shape)

    def library_parameters(self) -> dict[str, float]:
        return {"noise_e": self.strength} if self.variant < 2 else {}


class ColouredReadNoiseLaw(Law):
    """Noise of the video amplifier beside the pixels' own, along the rows as they are read. Variants: one pole, which
    keeps half of it a pixel further; double sampling that takes a pixel's reset from the one before; two such poles."""

    name = effect = "coloured_read_noise"
    variants, unit, nominal, limits, power, shown_by = 3, "e", 1.0, (0.1, 20.0), 2.0, DARK
    keep = 0.5

    def noise_e(self, shape: tuple[int, int], k: int) -> Array:
        white = self.rng(19, k).standard_normal((shape[0], shape[1] + 64))  # settled before the frame begins
        if self.variant == 1:
            noise = (white[:, 1:] - white[:, :-1]) / np.sqrt(2.0)
        else:
            noise = white
            for _ in range(1 if self.variant == 0 else 2):
                noise = lfilter([1.0], [1.0, -self.keep], noise, axis=1)
            keep2 = self.keep**2
            noise = noise * np.sqrt((1.0 - keep2) ** 3 / (1.0 + keep2) if self.variant == 2 else 1.0 - keep2)
        return self.strength * noise[:, -shape[1] :]

    def library_parameters(self) -> dict[str, float]:
        if self.variant == 2:
            return {}
        share = self.strength**2 / (self.strength**2 + self.camera.read_noise_e**2)
        return {"correlation": share * (self.keep if self.variant == 0 else -0.5)}


class PeriodicBandingLaw(Law):
    """A sinusoidal offset over the rows, of fixed period and random phase in each frame (related to row noise)."""

    name, unit, nominal, limits, power, shown_by = "periodic_banding", "e", 3.0, (0.1, 40.0), 2.0, DARK
    families = frozenset({"line_noise"})

    def noise_e(self, shape: tuple[int, int], k: int) -> Array:
        phase = self.rng(7, k).random()
        return (
            self.strength * np.sin(2 * np.pi * (np.arange(shape[0]) / (6.0 + 10.0 * self.uniform[0]) + phase))[:, None]
        )


class PinkNoiseLaw(Law):
    """1/f noise along the read-out. Variants: of one amplifier; of two, for even and odd columns; of one, with the same
    power an octave by eight filtered noises (Voss 1978), at rest between rows for a tenth of their time."""

    name, effect = "pink_noise", "reading_order_noise"
    variants, unit, nominal, limits, power, shown_by = 3, "e", 3.0, (0.2, 40.0), 2.0, DARK

    def noise_e(self, shape: tuple[int, int], k: int) -> Array:
        rows, cols = shape
        rng = self.rng(12, k)
        if self.variant == 1:
            noise = np.empty(shape)
            noise[:, ::2] = self._wave(rng, rows * ((cols + 1) // 2)).reshape(rows, -1)
            noise[:, 1::2] = self._wave(rng, rows * (cols // 2)).reshape(rows, -1)
        elif self.variant == 2:
            wide = cols + cols // 10
            line = np.zeros(rows * wide)
            for octave in range(18):  # correlated over 0.5, 1, 2, ... 65536 pixels
                keep = np.exp(-(2.0 ** (1 - octave)))
                white = np.sqrt(1.0 - keep * keep) * rng.standard_normal(rows * wide)
                line += lfilter([1.0], [1.0, -keep], white, zi=[keep * rng.standard_normal()])[0]
            noise = line.reshape(rows, wide)[:, :cols] / np.sqrt(18.0)
        else:
            noise = self._wave(rng, rows * cols).reshape(shape)
        return self.strength * noise

    @staticmethod
    def _wave(rng: np.random.Generator, n: int) -> Array:
        """1/f noise of standard deviation 1."""
        f = np.fft.rfftfreq(n)
        f[0] = 1.0
        wave = np.fft.irfft(np.fft.rfft(rng.standard_normal(n)) / np.sqrt(f), n)
        return (wave - wave.mean()) / wave.std()


class ColumnNoiseLaw(Law):
    """A fixed offset of each column. Variants: white; an alternation of odd and even columns in addition."""

    name = effect = "column_noise"
    variants, unit, nominal, limits, shown_by = 2, "e", 1.0, (0.02, 30.0), DARK

    def noise_e(self, shape: tuple[int, int], k: int) -> Array:
        white = self.rng(3).standard_normal(shape[1])
        return (
            self.strength * (white if self.variant == 0 else 0.7 * white + 0.7 * (-1.0) ** np.arange(shape[1]))[None, :]
        )


class RandomTelegraphNoiseLaw(Law):
    """Some pixels switch between two levels. Variants: equal amplitudes; exponentially distributed ones; equal ones,
    high in a quarter of the frames; equal ones that stay for four frames (slow traps)."""

    name = effect = "random_telegraph_noise"
    variants, unit, nominal, limits, power, shown_by = 4, "e", 15.0, (1.0, 200.0), 2.0, DARK

    def noise_e(self, shape: tuple[int, int], k: int) -> Array:
        still = self.rng(4)
        odd = still.random(shape) < 0.004
        size = self.strength * (still.exponential(0.7, shape) if self.variant == 1 else np.ones(shape))
        if self.variant == 2:
            return np.where(odd, size * ((self.rng(5, k).random(shape) < 0.25) - 0.25), 0.0)
        if self.variant == 3:  # each pixel's dwell begins at another of four frames
            begun = (k + still.integers(0, 4, shape)) // 4
            high = sum(np.where(begun == n, self.rng(5, int(n)).integers(0, 2, shape), 0) for n in np.unique(begun))
            return np.where(odd, size * (high - 0.5), 0.0)
        return np.where(odd, size * (self.rng(5, k).integers(0, 2, shape) - 0.5), 0.0)


class _Processing(Law):
    """A 3 x 3 filter on the converter's output. Variants of the kernel: cross; binomial."""

    variants, unit, nominal, limits, needs, shown_by = 2, "1", 0.1, (0.002, 0.6), "mono", OPTICAL
    direction: ClassVar[float]

    def processed_dn(self, dn: Array) -> Array:
        cross = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]]) / 4.0
        box = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 16.0
        blurred = convolve(dn, cross if self.variant == 0 else box, mode="mirror")
        return dn + self.direction * self.strength * (dn - blurred)


class OnChipSharpeningLaw(_Processing):
    """Sharpening in the camera."""

    name = effect = "on_chip_sharpening"
    direction = 1.0


class OnChipSmoothingLaw(_Processing):
    """Smoothing in the camera."""

    name = effect = "on_chip_smoothing"
    direction = -1.0


class DefectInterpolationLaw(Law):
    """Some pixels are replaced by the mean of two neighbours of their row: less noise there, broken edges."""

    name, unit, nominal, limits = "defect_interpolation", "%", 5.0, (0.1, 60.0)
    families = frozenset({"on_chip_processing"})

    def processed_dn(self, dn: Array) -> Array:
        odd = self.rng(11).random(dn.shape) < self.strength / 100
        step = 1 if self.camera.cfa == "MONO" else 2
        padded = np.pad(dn, [(0, 0), (step, step)], mode="reflect")
        return np.where(odd, 0.5 * (padded[:, : -2 * step] + padded[:, 2 * step :]), dn)


class JitteredRowsLaw(Law):
    """Every other row is displaced by a part of a pixel, by a fault of the sensor's timing."""

    name, unit, nominal, limits, power, needs, shown_by = "jittered_rows", "px", 0.3, (0.05, 1.0), 2.0, "mono", OPTICAL
    families = frozenset({"directional_contrast_loss"})

    def image(self, image: Array) -> Array:
        out = image.copy()
        out[1::2] = shift(image, (0.0, self.strength), order=3, mode="nearest")[1::2]
        return out
