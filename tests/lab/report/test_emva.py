"""The EMVA 1288 data sheet: its table, spectra and histograms, and their place on the page."""

from __future__ import annotations

import base64
import gzip
import json
import re

import numpy as np
import pytest

from lab.fit.noise.noise_fit import fit_noise
from lab.formats.recording_set import DataSheet, Manifest, RecordingSet
from lab.formats.result_file import provenance_of
from lab.formats.results import CameraFit, FitResult
from lab.report import render_report
from lab.report.emva import data_sheets, spectrogram

SHAPE = (64, 96)


def recordings(*, photons: bool, cfa: str = "MONO") -> RecordingSet:
    rng = np.random.default_rng(1)
    pattern = 1.0 + 0.01 * rng.standard_normal(SHAPE)
    hot = np.zeros(SHAPE)
    hot[10, 20] = 900.0
    captures, frames = [], {}
    for number, light in enumerate(np.linspace(0.05, 1.3, 16)):
        for kind in ("dark", "flat"):
            for _ in range(8 if number == 6 else 2):
                name = f"{kind}-{len(captures)}"
                capture = {"id": name, "kind": kind, "side": "left", "frame": name, "exposure_s": float(light)}
                if kind == "flat" and photons:
                    capture |= {"photons_per_pixel": 12000.0 * float(light), "wavelength_nm": 530.0}
                captures.append(capture)
                mean = (6000.0 * light * pattern if kind == "flat" else 0.0) + (30.0 + hot) * light
                charge = np.minimum(rng.poisson(mean), 6600) + 4.0 * rng.standard_normal(SHAPE)
                frames[name] = np.clip(np.rint(80.0 + 0.5 * charge), 0, 4095).astype(np.uint16)
    camera = DataSheet(rows=SHAPE[0], cols=SHAPE[1], cfa=cfa, bit_depth=12)
    return RecordingSet(Manifest(cameras={"left": camera}, captures=tuple(captures)), frames)


def fitted(given: RecordingSet) -> FitResult:
    return FitResult(source="memory", cameras={"left": CameraFit(noise=fit_noise(given, "left"))})


def test_a_sheet_with_photons_has_the_standards_table_and_plots() -> None:
    given = recordings(photons=True)
    (sheet,) = data_sheets(given, fitted(given))
    texts = {row.symbol: row.values[0] for row in sheet.rows}
    assert set(texts) >= {
        "η",
        "R",
        "K",
        "σ_d",
        "μ_p.min",
        "μ_p.sat",
        "DR",
        "SNR_max",
        "LE",
        "DSNU1288",
        "PRNU1288",
        "μ_I.mean",
    }
    assert all("±" in text for text in texts.values())
    assert re.match(r"0\.5\d* ± 0\.\d+ DN/e", texts["K"]) or re.match(r"0\.49\d* ± 0\.\d+ DN/e", texts["K"])
    assert "dB" in texts["DR"]
    assert [plot.title for plot in sheet.plots] == [
        "Photon transfer",
        "Responsivity",
        "Signal-to-noise ratio",
        "Linearity",
        "Dark signal against exposure",
        "Spectrograms of the DSNU",
        "Spectrograms of the PRNU",
        "Histograms of the DSNU",
        "Histograms of the PRNU",
        "Profiles of the DSNU",
        "Profiles of the PRNU",
        "Read noise of single pixels",
    ]
    assert "1 pixels are hot" in sheet.defects
    assert "row 10, column 20" in sheet.defects
    assert [title for title, _, _ in sheet.maps] == ["Offset", "Dark current", "Gain, shading removed"]


def test_a_sheet_without_photons_says_so() -> None:
    given = recordings(photons=False, cfa="RGGB")
    (sheet,) = data_sheets(given, fitted(given))
    assert sheet.planes == ("R", "G1", "G2", "B")
    assert sheet.plotted == "G1"
    assert not any(row.symbol == "η" for row in sheet.rows)
    assert any("photons not stated" in condition for condition in sheet.conditions)
    assert sheet.channels == ("R", "G", "B")
    assert any(row.quantity == "temporal dark noise (read noise)" for row in sheet.channel_rows)


def test_spectra_are_flat_for_white_patterns_and_peak_for_lines() -> None:
    rng = np.random.default_rng(2)
    white = 3.0 * rng.standard_normal((400, 256))
    frequency, amplitude = spectrogram(white)
    # 400 rows: each frequency's power is known to 1 / sqrt(400) (twice that at the last); four of these, halved by the
    # root.
    assert np.all(np.abs(amplitude[:-1] / 3.0 - 1.0) < 0.11)
    assert frequency[0] == pytest.approx(1 / 256)
    assert frequency[-1] == 0.5
    striped = white + 2.0 * np.cos(2.0 * np.pi * 0.25 * np.arange(256))
    assert frequency[np.argmax(spectrogram(striped)[1])] == 0.25


def test_the_sheet_stands_on_the_page() -> None:
    given = recordings(photons=True)
    page = render_report(given, fitted(given), None, None, provenance_of(given))
    assert 'id="emva"' in page
    assert "EMVA 1288 data sheet" in page
    packed = re.findall(r'<script type="text/plain" id="charts">(.*?)</script>', page)
    charts = [json.loads(line) for line in gzip.decompress(base64.b64decode(packed[0])).decode().splitlines()]
    titles = [chart["layout"]["yaxis"].get("title", {}).get("text", "") for chart in charts]
    assert any("rms amplitude" in title for title in titles)
    assert "http://" not in page.split('<script type="text/plain"')[0].replace("http://www.w3.org", "")


def test_without_figures_there_is_no_sheet() -> None:
    given = recordings(photons=True)
    fit = FitResult(source="memory", cameras={"left": CameraFit()})
    assert list(data_sheets(given, fit)) == []
    assert 'id="emva"' not in render_report(given, fit, None, None, provenance_of(given))
