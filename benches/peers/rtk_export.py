"""Reads what `conefield convert SCAN FOLDER --to rtk` wrote with RTK's own readers, reconstructs it with RTK's FDK, and
compares with the true volume as it is and flipped along each axis: the conventions are right if no flip fits better.

usage: rtk_export.py FOLDER TRUTH.nii.gz PEAK MM    (MM: millimetres in the truth's unit of length)
"""
import itertools, sys
import itk
import nibabel
import numpy as np
from itk import RTK as rtk

folder, truth, peak, mm = sys.argv[1], nibabel.load(sys.argv[2]), float(sys.argv[3]), float(sys.argv[4])
truth, spacing = np.asarray(truth.dataobj, np.float32), [float(s) for s in truth.header.get_zooms()[:3]]
Image = itk.Image[itk.F, 3]

reader = rtk.ThreeDCircularProjectionGeometryXMLFileReader.New()
reader.SetFilename(f"{folder}/geometry.xml")
reader.GenerateOutputInformation()
geometry = reader.GetOutputObject()
projections = itk.imread(f"{folder}/projections.mha", itk.F)

# RTK's (x, y, z) are our (y, z, x), and its arrays count [z, y, x].
x, y, z = truth.shape
volume = itk.image_from_array(np.zeros((x, z, y), np.float32))
sides = [spacing[1], spacing[2], spacing[0]]
volume.SetSpacing(sides)
volume.SetOrigin([-(n - 1) / 2 * s for n, s in zip((y, z, x), sides)])

displaced = rtk.DisplacedDetectorImageFilter[Image].New()
displaced.SetInput(projections)
displaced.SetGeometry(geometry)
displaced.Update()
fdk = rtk.FDKConeBeamReconstructionFilter[Image].New()
fdk.SetInput(0, volume)
fdk.SetInput(1, displaced.GetOutput())
fdk.SetGeometry(geometry)
fdk.GetRampFilter().SetTruncationCorrection(0.0)
fdk.GetRampFilter().SetHannCutFrequency(0.7)
fdk.Update()
found = np.transpose(itk.array_from_image(fdk.GetOutput()), (0, 2, 1)) * mm

for signs in itertools.product([1, -1], repeat=3):
    flipped = found[:: signs[0], :: signs[1], :: signs[2]]
    psnr = 10 * np.log10(peak**2 / np.mean((flipped - truth) ** 2))
    print(f"{psnr:6.2f} dB  {'as it is' if signs == (1, 1, 1) else f'flipped {signs}'}")
