"""Golden rays from batoid 0.9.0 (BSD), an independent tracer. Made once, with batoid installed apart from calibench:

    python tests/sim/optics/reference_batoid.py > tests/sim/optics/data/batoid.csv

The two lenses are those of `lenses/doublet.zmx` and `lenses/tilted.zmx`, written down here once more by hand, so that
the reader is checked as well. Rays start in the plane of the stop, which is the first surface; lengths in mm, indices
those at 587.5618 nm.
"""

import csv
import math
import sys

import batoid
import numpy as np

AIR = 1.0


DOUBLET = [
    # surface, distance from the stop, index behind
    (batoid.Asphere(1 / 0.16, -0.6, [-1.2e-3, 2.0e-5]), 0.8, 1.5312),
    (batoid.Asphere(-1 / 0.12, 0.4, [2.5e-3, -4.0e-5]), 3.2, AIR),
    (batoid.Sphere(-1 / 0.19), 4.3, 1.6355),
    (batoid.Asphere(-1 / 0.11, 0.0, [1.5e-3]), 5.0, AIR),
    (batoid.Plane(), 11.7, AIR),
]


def doublet():
    return [(surface, batoid.CoordSys(np.array([0, 0, z]), np.eye(3)), index) for surface, z, index in DOUBLET]


def tilted():
    turned = batoid.RotX(np.deg2rad(3.0)) @ batoid.RotY(np.deg2rad(-2.0)) @ batoid.RotZ(np.deg2rad(10.0))
    first = np.array([0.15, -0.1, 1.5])
    axis = turned[:, 2]
    second = first + 1.6 * axis
    third = second + 0.9 * axis
    last = turned @ batoid.RotX(np.deg2rad(1.2))
    return [
        (batoid.Asphere(1 / 0.08, -0.9, [-4.0e-4]), batoid.CoordSys(first, turned), 1.5168),
        (batoid.Sphere(-1 / 0.02), batoid.CoordSys(second, turned), AIR),
        (batoid.Plane(), batoid.CoordSys(third + 18.4 * last[:, 2], last), AIR),
    ]


def main():
    out = csv.writer(sys.stdout, lineterminator="\n")
    out.writerow(["lens", "tan_x", "tan_y", "px_mm", "py_mm", "x_mm", "y_mm", "cosine_x", "cosine_y", "path_mm"])
    lenses = {"doublet": (doublet(), 0.6, 18.0), "tilted": (tilted(), 1.0, 6.0)}
    for name, (surfaces, radius, field_deg) in lenses.items():
        for share_x, share_y in ((0.0, 0.0), (0.0, 0.7), (0.4, -0.6), (0.0, 1.0)):
            tan_x, tan_y = (share * math.tan(math.radians(field_deg)) for share in (share_x, share_y))
            length = math.sqrt(1 + tan_x**2 + tan_y**2)
            direction = np.array([tan_x, tan_y, 1.0]) / length
            for px, py in ((0, 0), (0.9, 0), (0, -0.95), (-0.5, 0.6), (0.3, 0.3)):
                start = np.array([px * radius, py * radius, 0.0])
                ray = batoid.RayVector(*start, *direction, float(direction @ start), 587.5618e-9)
                before = batoid.ConstMedium(AIR)
                for surface, place, index in surfaces:
                    behind = batoid.ConstMedium(index)
                    ray = batoid.refract(surface, ray, before, behind, coordSys=place)
                    before = behind
                # Where a ray ends in the image's own frame: the last `refract` leaves it there.
                if ray.failed[0]:
                    raise SystemExit(f"{name}: the ray through ({px}, {py}) fails in batoid")
                ended = (ray.x[0], ray.y[0], ray.vx[0], ray.vy[0], ray.t[0])
                out.writerow([name, *(repr(float(value)) for value in (tan_x, tan_y, *start[:2], *ended))])


if __name__ == "__main__":
    main()
