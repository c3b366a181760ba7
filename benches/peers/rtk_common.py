"""A conefield scan folder as RTK (itk-rtk, CPU) has it."""
import tomllib
import itk
import numpy as np
from itk import RTK as rtk

Image = itk.Image[itk.F, 3]


def image(array, spacing, center=True):
    """An ITK image over `array` [slow, mid, fast], centred on the origin."""
    out = itk.image_from_array(np.ascontiguousarray(array))
    out.SetSpacing(spacing)
    size = array.shape[::-1]
    out.SetOrigin([-(n - 1) / 2 * s if center or k < 2 else 0.0 for k, (n, s) in enumerate(zip(size, spacing))])
    return out


class Scan:
    def __init__(self, folder):
        about = tomllib.load(open(f"{folder}/scan.toml", "rb"))
        self.orbit, self.shape, self.spacing = about["orbit"], about["volume"]["shape"], about["volume"]["spacing"]
        self.projections = np.load(f"{folder}/projections.npy").astype(np.float32)
        self.mm = about.get("unit", {}).get("mm", 1.0)
        self.geometry = rtk.ThreeDCircularProjectionGeometry.New()
        for a in self.orbit["angles"]:
            self.geometry.AddProjection(self.orbit["dso"], self.orbit["dsd"], 90.0 - np.degrees(a))

    def stack(self, array):
        """Projections; RTK's u and v run against ours."""
        v, u = self.orbit["pixel"]
        return image(array[:, ::-1, ::-1], [u, v, 1.0], center=False)

    def volume(self, array):
        """A volume [x, y, z] in RTK's axes (x, z, y): its y is the axis of rotation."""
        return image(np.transpose(array, (1, 2, 0)), [self.spacing[0], self.spacing[2], self.spacing[1]])

    def forward(self, volume):
        """RTK's line integrals (Joseph) of an image that `volume` made, as RTK has them."""
        f = rtk.JosephForwardProjectionImageFilter[Image, Image].New()
        f.SetInput(0, self.stack(np.zeros_like(self.projections)))
        f.SetInput(1, volume)
        f.SetGeometry(self.geometry)
        f.Update()
        return f.GetOutput()
