"""Sensors by Pyxel (package `pyxel-sim`): T. Prod'homme et al., Pyxel: a novel and multi-purpose Python-based framework
for imaging detector simulation, JATIS 8 (2022) 048002.

Shot noise, read noise, gain and rounding are numpy's; the effect is Pyxel's own model.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import numpy as np
from pyxel.detectors import CMOS, Channels, Characteristics, CMOSGeometry, Environment
from pyxel.detectors.channels import Matrix, ReadoutPosition
from pyxel.detectors.characteristics import ChargeToVoltSettings
from pyxel.models.charge_collection.fixed_pattern_noise import fixed_pattern_noise
from pyxel.models.charge_collection.utils_persistence import compute_simple_persistence
from pyxel.models.charge_generation import avalanche, data
from pyxel.models.charge_generation.cosmix.cosmix import Cosmix, set_particle_spectrum
from pyxel.models.charge_generation.dark_current import dark_current
from pyxel.models.charge_measurement.alternating_column_noise_cmos import alternating_column_noise_cmos
from pyxel.models.charge_measurement.inter_pixel_capacitance import ipc_kernel, simple_ipc
from pyxel.models.charge_measurement.linearity import compute_poly_linearity
from pyxel.models.charge_measurement.uncorrelated_pink_noise_cmos import uncorrelated_pink_noise_cmos
from pyxel.models.charge_measurement.utils_amplifier_crosstalk import crosstalk_signal_dc
from pyxel.models.charge_transfer.utils_cdm import run_cdm_parallel, run_cdm_serial
from pyxel.util import set_random_seed
from scipy.ndimage import label

from evaluation.third_party.camera import DrawnCamera
from evaluation.third_party.models import SimulatedSensor, SimulatorCheck
from sim.sensor.margins import Margins
from sim.spectrum import FloatArray

#: Volts an electron, by which Pyxel's signals are read back.
VOLT_PER_E = 1e-6
TRANSFER_S, CLOUD_CM3 = 1e-3, 1e-10


def _detector(rows: int, cols: int, channels: Channels | None = None) -> CMOS:
    return CMOS(
        geometry=CMOSGeometry(
            row=rows, col=cols, total_thickness=10.0, pixel_vert_size=5.0, pixel_horz_size=5.0, channels=channels
        ),
        environment=Environment(temperature=293),
        characteristics=Characteristics(
            quantum_efficiency=1.0, charge_to_volt=ChargeToVoltSettings(value=VOLT_PER_E), pre_amplification=1,
            adc_bit_resolution=12, adc_voltage_range=(0.0, 10.0), full_well_capacity=100000,
        ),
    )  # fmt: skip


@dataclass
class PyxelTransfer(SimulatedSensor):
    """Charge transfer inefficiency by Short's charge distortion model (CDM), one species, a cloud in proportion."""

    axis: int = 0
    loss: float = 5e-4
    release_px: float = 1.0
    full_well_e: float = 1e4

    @classmethod
    def draw(cls, rng: np.random.Generator, camera: DrawnCamera) -> PyxelTransfer:
        axis, release = int(rng.integers(2)), float(rng.uniform(1.0, 3.0))
        # of the last line traps take at most an eighth of what is left: all transfers at once then lose, in the mean of
        # the frame, 3 to 6 % less than one after the other
        taken = float(rng.uniform(0.05, 0.125))
        loss = taken * np.exp(-1.0 / release) / (camera.rows, camera.cols)[axis]
        names = ("parallel_ppm", "release_px") if axis == 0 else ("serial_ppm", "serial_release_px")
        truth = dict(zip(names, (1e6 * loss, release), strict=True))
        return cls(truth, "hot pixels", axis, loss, release, camera.full_well_e)

    def collect(self, mean_e: FloatArray, exposure_s: float, rng: np.random.Generator) -> FloatArray:
        return self._clock(rng.poisson(mean_e).astype(float))

    def _clock(self, electrons: FloatArray) -> FloatArray:
        # with a cloud in proportion to the packet, traps take g N of N electrons a transfer and keep exp(-1 / release)
        density = self.loss / np.exp(-1.0 / self.release_px) * self.full_well_e / (2.0 * CLOUD_CM3)
        run = run_cdm_parallel if self.axis == 0 else run_cdm_serial
        out = run(
            array=electrons, beta=1.0, vg=CLOUD_CM3, t=TRANSFER_S, fwc=self.full_well_e, vth=1e7,
            tr=np.array([self.release_px * TRANSFER_S]), nt=np.array([density]), sigma=np.array([1e-6]),
        )  # fmt: skip
        return np.asarray(out)

    def check(self) -> SimulatorCheck:
        """Of one bright pixel after n transfers the traps keep g b / (1 + g) once it has gone on, g = n loss / b: all n
        transfers act at once in this model, which takes a share g of that from n loss."""
        frame, n = np.zeros((100, 100)), 60
        frame[n, n] = 1000.0
        read = float(self._clock(frame)[n, n]) / 1000.0
        at_once = n * self.loss / np.exp(-1.0 / self.release_px)
        return SimulatorCheck(n * self.loss / (1.0 + at_once), 1.0 - read, 1e-6)


@dataclass
class OverscanTransfer(PyxelTransfer):
    """The same in frames with 16 rows and columns of overscan, and without hot pixels: flats tell it by these lines."""

    overscan_px: int = 16

    @classmethod
    def draw(cls, rng: np.random.Generator, camera: DrawnCamera) -> OverscanTransfer:
        drawn = PyxelTransfer.draw(rng, camera)
        return cls(drawn.truth, "usual", drawn.axis, drawn.loss, drawn.release_px, drawn.full_well_e)

    @property
    def margins(self) -> Margins:
        return Margins(overscan_rows=(0, self.overscan_px), overscan_cols=(0, self.overscan_px))

    def collect(self, mean_e: FloatArray, exposure_s: float, rng: np.random.Generator) -> FloatArray:
        return self._clock(self.margins.surround(rng.poisson(mean_e).astype(float)))

    def check(self) -> SimulatorCheck:
        """Behind n lines of even light N, traps hold b g N / (1 + (1 - b) g), g = n loss / b. The overscan reads it but
        for the share b^16: the extended pixel edge response. g grows by a hundredth from line to line."""
        n = 100
        frame = self.margins.surround(np.full((n, n), 1000.0))
        read = np.moveaxis(self._clock(frame), self.axis, 0)
        held = float(np.exp(-1.0 / self.release_px))
        taken = (n - 1) * self.loss / held
        wanted = taken * held / (1.0 + (1.0 - held) * taken) * (1.0 - held**self.overscan_px)
        return SimulatorCheck(wanted, float(read[n:, n // 2].sum()) / 1000.0, 0.02 * wanted)


@dataclass
class PyxelPersistence(SimulatedSensor):
    """Simple persistence of kinds of traps without a capacity: in an exposure T they fill or empty by T / tau.

    shares, releases_s : of each kind of traps
    """

    shares: tuple[float, ...] = (0.02,)
    releases_s: tuple[float, ...] = (20.0,)
    trapped: FloatArray | None = None

    @classmethod
    def draw(cls, rng: np.random.Generator, camera: DrawnCamera) -> PyxelPersistence:
        return cls({}, "dark after bright", (float(rng.uniform(0.01, 0.05)),), (float(rng.uniform(10.0, 40.0)),))

    @classmethod
    def draw_several(cls, rng: np.random.Generator, camera: DrawnCamera) -> PyxelPersistence:
        """Draw three kinds of traps, as infrared arrays have, each slower than the one before."""
        shares = rng.uniform(0.005, 0.03, 3)
        releases_s = np.array([5.0, 20.0, 100.0]) * rng.uniform(0.8, 1.6, 3)
        return cls({}, "dark after bright", tuple(shares.tolist()), tuple(releases_s.tolist()))

    def collect(self, mean_e: FloatArray, exposure_s: float, rng: np.random.Generator) -> FloatArray:
        if self.trapped is None:
            self.trapped = np.zeros((len(self.shares), *mean_e.shape))
        electrons, self.trapped = compute_simple_persistence(
            pixel_array=rng.poisson(mean_e).astype(float), all_trapped_charge=self.trapped,
            trap_densities=np.array(self.shares), trap_time_constants=np.array(self.releases_s), delta_t=exposure_s,
        )  # fmt: skip
        return np.asarray(electrons)

    def check(self) -> SimulatorCheck:
        """After a frame of 10,000 e in T the traps hold share T / tau of it, and a dark frame in T gets T / tau of
        that, each kind by its own; kinds after the first find what those before took, a few per mille less."""
        fresh, exposure_s = PyxelPersistence({}, self.plan, self.shares, self.releases_s), 1.0
        fresh.collect(np.full((200, 200), 1e4), exposure_s, rng := np.random.default_rng(1))
        got = float(np.mean(fresh.collect(np.zeros((200, 200)), exposure_s, rng)))
        asked = 1e4 * sum(s * (exposure_s / tau) ** 2 for s, tau in zip(self.shares, self.releases_s, strict=True))
        taken = sum(s * exposure_s / tau for s, tau in zip(self.shares, self.releases_s, strict=True))
        several = 0.0 if len(self.shares) == 1 else 2.0 * taken
        return SimulatorCheck(asked, got, asked * (3.0 * 1e-2 / 200.0 + several) + 1e-6)


@dataclass
class Capacitance(SimulatedSensor):
    """Inter-pixel capacitance of unequal axes, with corners."""

    coupling: float = 0.01
    corner: float = 0.0
    unequal: float = 0.0

    @classmethod
    def draw(cls, rng: np.random.Generator, camera: DrawnCamera) -> Capacitance:
        coupling = float(rng.uniform(0.006, 0.02))
        corner, unequal = coupling * float(rng.uniform(0.0, 0.3)), coupling * float(rng.uniform(-0.4, 0.4))
        # Pyxel couples more along the row where `unequal` is positive
        truth = {
            "share_percent": 100.0 * coupling,
            "row_excess": unequal / coupling,
            "corner_share": corner / coupling,
        }
        return cls(truth, "usual", coupling, corner, unequal)

    def read(self, electrons: FloatArray, rng: np.random.Generator) -> FloatArray:
        detector = _detector(*electrons.shape)
        detector.pixel.array = electrons
        simple_ipc(detector, self.coupling, self.corner, self.unequal)
        return np.asarray(detector.signal.array, float) / VOLT_PER_E

    def check(self) -> SimulatorCheck:
        """The pixel beside a bright one has the coupling in the row; the transform is good to 1e-3 of that."""
        frame = np.zeros((64, 64))
        frame[32, 32] = 1e4
        read = self.read(frame, np.random.default_rng(1))
        asked = float(ipc_kernel(self.coupling, self.corner, self.unequal)[1, 0])
        return SimulatorCheck(self.coupling + self.unequal, float(read[32, 33]) / 1e4, 1e-3 * abs(asked) + 1e-6)


@dataclass
class Bend(SimulatedSensor):
    """A response that bends as a polynomial of the output node's signal."""

    quadratic: float = 0.02
    full_well_e: float = 1e4

    @classmethod
    def draw(cls, rng: np.random.Generator, camera: DrawnCamera) -> Bend:
        bend = float(rng.uniform(0.015, 0.05)) * float(rng.choice([-1.0, 1.0]))
        return cls({}, "usual", bend, camera.full_well_e)

    def read(self, electrons: FloatArray, rng: np.random.Generator) -> FloatArray:
        return np.asarray(compute_poly_linearity(electrons, [0.0, 1.0, self.quadratic / self.full_well_e]))

    def check(self) -> SimulatorCheck:
        """At half of full well the signal departs by half of the bend."""
        half = np.full((2, 2), 0.5 * self.full_well_e)
        departure = float(self.read(half, np.random.default_rng(1))[0, 0] / half[0, 0]) - 1.0
        return SimulatorCheck(0.5 * self.quadratic, departure, 1e-9)


@dataclass
class PyxelCrosstalk(SimulatedSensor):
    """DC crosstalk of two amplifiers, each of which reads half of the columns in the same direction."""

    coupling: float = 0.005

    @classmethod
    def draw(cls, rng: np.random.Generator, camera: DrawnCamera) -> PyxelCrosstalk:
        coupling = float(rng.uniform(0.004, 0.012)) * float(rng.choice([-1.0, 1.0]))
        return cls({"share_percent": 100.0 * coupling}, "usual", coupling)

    def read(self, electrons: FloatArray, rng: np.random.Generator) -> FloatArray:
        channels = Channels(
            matrix=Matrix([["left", "right"]]),
            readout_position=ReadoutPosition({"left": "top-left", "right": "top-left"}),
        )
        matrix = np.array([[0.0, self.coupling], [self.coupling, 0.0]])
        return np.asarray(crosstalk_signal_dc(electrons.copy(), matrix, channels, electrons.shape))

    def check(self) -> SimulatorCheck:
        """A bright pixel has a ghost at the same place of the other half."""
        frame = np.zeros((8, 16))
        frame[3, 2] = 1e4
        return SimulatorCheck(self.coupling, float(self.read(frame, np.random.default_rng(1))[3, 10]) / 1e4, 1e-9)


@dataclass
class Avalanche(SimulatedSensor):
    """An avalanche's excess noise: gains of a gamma distribution, codes of the mean electron."""

    excess: float = 1.5

    @classmethod
    def draw(cls, rng: np.random.Generator, camera: DrawnCamera) -> Avalanche:
        excess = float(rng.uniform(1.4, 2.0))
        return cls({"excess_percent": 100.0 * (excess - 1.0)}, "faint flats", excess)

    def collect(self, mean_e: FloatArray, exposure_s: float, rng: np.random.Generator) -> FloatArray:
        out: dict[str, FloatArray] = {}
        electrons = rng.poisson(mean_e).astype(float)
        mean_gain = SimpleNamespace(avalanche_bias=1.0, bias_to_gain=np.ones_like)
        detector: Any = SimpleNamespace(
            pixel=np.zeros(electrons.shape),
            characteristics=SimpleNamespace(avalanche_settings=mean_gain, charge_to_volt_conversion=0.0),
            charge=SimpleNamespace(
                array=electrons, empty=lambda: None, add_charge_array=lambda array: out.update(multiplied=array)
            ),
        )
        avalanche.avalanche_gain(detector, excess_noise_factor=self.excess, seed=int(rng.integers(2**31)))
        return np.nan_to_num(np.asarray(out["multiplied"]))

    def check(self) -> SimulatorCheck:
        """The variance over the mean is the factor."""
        drawn = self.collect(np.full((200, 200), 1000.0), 0.01, np.random.default_rng(1))
        return SimulatorCheck(
            self.excess, float(np.var(drawn) / np.mean(drawn)), 3.0 * self.excess * np.sqrt(2.0 / drawn.size)
        )


@dataclass
class PinkNoise(SimulatedSensor):
    """Pink noise in reading order, of one amplifier, or of one of even and one of odd columns."""

    std_e: float = 4.0
    alternating: bool = False
    detector: Any = field(default=None, repr=False)

    @classmethod
    def draw(cls, rng: np.random.Generator, camera: DrawnCamera) -> PinkNoise:
        alternating = bool(rng.integers(2))
        std_e = camera.read_noise_e * float(rng.uniform(0.6, 1.5))
        return cls({}, "usual", std_e, alternating)

    def read(self, electrons: FloatArray, rng: np.random.Generator) -> FloatArray:
        if self.detector is None:
            self.detector, seed = _detector(*electrons.shape), int(rng.integers(2**31))
        else:
            seed = None
        self.detector.signal.array = electrons * VOLT_PER_E
        law = alternating_column_noise_cmos if self.alternating else uncorrelated_pink_noise_cmos
        law(self.detector, std=self.std_e, seed=seed)
        return np.asarray(self.detector.signal.array, float) / VOLT_PER_E

    def check(self) -> SimulatorCheck:
        """The standard deviation over several frames is the one that was asked for; slow waves leave a fifth open."""
        fresh = PinkNoise({}, "usual", self.std_e, self.alternating)
        rng = np.random.default_rng(1)
        drawn = np.array([fresh.read(np.full((96, 128), 1000.0), rng) for _ in range(20)])
        return SimulatorCheck(self.std_e, float(np.sqrt(np.mean(np.square(drawn - 1000.0)))), 0.2 * self.std_e)


@dataclass
class PyxelDark(SimulatedSensor):
    """Dark current by temperature, with its shot noise, in place of the drawn camera's: a healthy sensor.

    drawn_e_per_s : the drawn camera's, which `collect` is given in the mean
    """

    drawn_e_per_s: float = 5.0
    temperature_k: float = 293.0
    figure_na_per_cm2: float = 1e-3

    @classmethod
    def draw(cls, rng: np.random.Generator, camera: DrawnCamera) -> PyxelDark:
        temperature_k = float(rng.uniform(283.0, 303.0))
        unit = cls({}, "usual", camera.dark_e_per_s, temperature_k, 1.0)
        wanted = camera.dark_e_per_s * float(rng.uniform(0.5, 3.0))
        return cls({}, "usual", camera.dark_e_per_s, temperature_k, wanted / unit.rate())

    def rate(self) -> float:
        """Return the closed form, e/s of a pixel of 25 um^2: 1e7 P D 2.55e15 T^1.5 exp(-E / 2 k T), with the factor by
        which it is D, in nA / cm^2, at 300 K."""
        k_ev, charge_c, area_cm2, room_k = 8.617333e-5, 1.602177e-19, 25e-8, 300.0

        def power(kelvin: float) -> float:
            gap_ev = 1.1557 - 7.021e-4 * kelvin**2 / (1108.0 + kelvin)
            return float(kelvin**1.5 * np.exp(-gap_ev / (2.0 * k_ev * kelvin)))

        at_room = area_cm2 * self.figure_na_per_cm2 * 1e-9 / charge_c
        return at_room * power(self.temperature_k) / power(room_k)

    def _dark_e(self, shape: tuple[int, ...], exposure_s: float, seed: int) -> FloatArray:
        detector = _detector(*shape)
        detector.environment.temperature = self.temperature_k
        detector.set_readout(times=[exposure_s], non_destructive=False)
        detector.readout_properties.time_step = exposure_s
        dark_current(detector, figure_of_merit=self.figure_na_per_cm2, seed=seed)
        return np.asarray(detector.charge.array, float)

    def collect(self, mean_e: FloatArray, exposure_s: float, rng: np.random.Generator) -> FloatArray:
        light_e = np.maximum(mean_e - self.drawn_e_per_s * exposure_s, 0.0)
        return rng.poisson(light_e) + self._dark_e(mean_e.shape, exposure_s, int(rng.integers(2**31)))

    def check(self) -> SimulatorCheck:
        """The mean of 200 x 200 pixels in a second; constants of nature in four digits leave 2 %."""
        got = float(np.mean(self._dark_e((200, 200), 1.0, 1)))
        asked = self.rate()
        return SimulatorCheck(asked, got, 0.02 * asked + 3.0 * np.sqrt(asked) / 200.0)


@dataclass
class Columns(SimulatedSensor):
    """Sensitivities of columns by the model of a fixed pattern, after the shot noise."""

    std: float = 0.01
    factors: FloatArray | None = None

    @classmethod
    def draw(cls, rng: np.random.Generator, camera: DrawnCamera) -> Columns:
        std = float(rng.uniform(0.005, 0.02))
        factors = 1.0 + std * rng.standard_normal(camera.cols)
        # the law draws columns of that standard deviation: those at hand scatter about it by 1 / sqrt(2 columns)
        return cls({"gain_percent": 100.0 * float(factors.std())}, "usual", std, factors / factors.mean())

    def read(self, electrons: FloatArray, rng: np.random.Generator) -> FloatArray:
        assert self.factors is not None
        detector = _detector(*electrons.shape)
        detector.pixel.array = electrons
        with TemporaryDirectory() as folder:
            file = Path(folder) / "columns.npy"
            np.save(file, np.tile(self.factors, (len(electrons), 1)))
            fixed_pattern_noise(detector, filename=file)
        return np.asarray(detector.pixel.array, float)

    def check(self) -> SimulatorCheck:
        """Even electrons scatter from column to column as asked."""
        assert self.factors is not None
        read = self.read(np.full((4, len(self.factors)), 1e4), np.random.default_rng(1))
        return SimulatorCheck(float(self.factors.std()), float(read[0].std()) / 1e4, 1e-9)


@dataclass
class Protons(SimulatedSensor):
    """Tracks of protons of 100 MeV by CosmiX, of any direction: a Poisson number of them in each exposure."""

    per_s: float = 3.0
    pitch_um: float = 5.0
    depth_um: float = 20.0

    @classmethod
    def draw(cls, rng: np.random.Generator, camera: DrawnCamera) -> Protons:
        per_s = float(rng.uniform(0.6, 2.5))
        area_cm2 = camera.rows * camera.cols * (1e-4 * camera.pitch_um) ** 2
        return cls(
            {"rate_per_cm2_s": per_s / area_cm2}, "usual", per_s, camera.pitch_um, float(rng.uniform(10.0, 20.0))
        )

    def _simulation(self, shape: tuple[int, ...]) -> Any:
        detector = CMOS(
            geometry=CMOSGeometry(
                row=shape[0], col=shape[1], total_thickness=self.depth_um, pixel_vert_size=self.pitch_um,
                pixel_horz_size=self.pitch_um,
            ),
            environment=Environment(temperature=293), characteristics=Characteristics(),
        )  # fmt: skip
        cosmix = Cosmix(
            detector=detector, simulation_mode="cosmic_ray", particle_type="proton", initial_energy=100.0,
            particle_number=0, incident_angle_alpha="random", incident_angle_beta="random", start_pos_ver="random",
            start_pos_hor="random", start_pos_z="random", progressbar=False,
        )  # fmt: skip
        cosmix.set_stepsize()
        file = Path(data.__path__[0]) / "proton_L2_solarMax_11mm_Shielding.txt"
        geometry = detector.geometry
        cosmix.sim_obj.spectrum_cdf = set_particle_spectrum(file, geometry.vert_dimension, geometry.horz_dimension)
        return cosmix.sim_obj

    def _tracks(self, shape: tuple[int, ...], count: int, seed: int) -> tuple[FloatArray, int]:
        """Return the electrons of `count` protons, and how many of these left any."""
        tracks, simulation = np.zeros(shape), self._simulation(shape)
        with set_random_seed(seed):
            for _ in range(count):
                simulation.event_generation()
        row, col = (np.array(p) // self.pitch_um for p in (simulation.e_pos0_lst, simulation.e_pos1_lst))
        if len(row):
            np.add.at(tracks, (row.astype(int), col.astype(int)), np.array(simulation.e_num_lst_per_step, float))
        return tracks, len(simulation.e_num_lst_per_event)

    def collect(self, mean_e: FloatArray, exposure_s: float, rng: np.random.Generator) -> FloatArray:
        count, seed = int(rng.poisson(self.per_s * exposure_s)), int(rng.integers(2**31))
        return rng.poisson(mean_e) + self._tracks(mean_e.shape, count, seed)[0]

    def check(self) -> SimulatorCheck:
        """Connected pixels above 40 e, eight neighbours, of a proton: one track. On pixels of 5 um it falls apart into
        four, as the simulator's steps leave next to nothing in between; on those of 24 um it doesn't. Its charge isn't
        held: the simulator's tables give some 56 e a um, and 373 follow from a loss of 5.76 MeV cm^2 / g (PSTAR, 100
        MeV, 2.33 g / cm^3, 3.6 eV an electron). The depth and the points that the library fits take that up."""
        pieces = [label(self._tracks((100, 100), 1, seed)[0] > 40.0, np.ones((3, 3)))[1] for seed in range(1, 61)]
        return SimulatorCheck(1.0, float(np.mean(pieces)), 0.25)
