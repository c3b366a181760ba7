//! The circular orbit that some formats require.

use conefield_core::error::ensure;
use conefield_core::geometry::VoxelGrid;
use conefield_core::orbit::{Beam, CircularOrbit};
use conefield_core::scan::{Scan, Volume};
use conefield_core::{Error, Result};

/// The orbits of `train` and `test` for a `format` that supports only circles, the same for both scans. Refuses
/// anything else, a test scan with another detector or grid, and a `volume` that does not fill the grid.
pub(crate) fn common_orbit(
    place: &str,
    format: &str,
    train: &Scan,
    test: Option<&Scan>,
    volume: Option<&Volume>,
) -> Result<(CircularOrbit, Option<CircularOrbit>)> {
    let fit = |name: &str, s: &Scan| -> Result<CircularOrbit> {
        s.validate(&format!("{place}: {name}"))?;
        CircularOrbit::fit(&s.geometry.views).ok_or_else(|| {
            let why = format!("{format} only knows circles about z; write conefield's own format");
            Error::unsupported(format!("{place}: {name} views that are not one circle"), why)
        })
    };
    let orbit = fit("training", train)?;
    if let Some(v) = volume {
        let (found, grid) = (v.data.shape(), train.geometry.volume.shape);
        ensure(found == grid, place, "shape of the volume", format!("{found:?}"), format!("{grid:?}"))?;
    }
    let Some(test) = test else { return Ok((orbit, None)) };
    let other = fit("test", test)?;
    let near = |a: f64, b: f64| (a - b).abs() <= 1e-6 * orbit.dsd;
    // The source of a parallel beam is far beyond any pixel.
    let fine = 1e-6 * orbit.dsd.min(1e4 * orbit.pixel[0]);
    let on_detector = |a: f64, b: f64| (a - b).abs() <= fine;
    let same = near(other.dso, orbit.dso)
        && near(other.dsd, orbit.dsd)
        && (0..2).all(|k| on_detector(other.pixel[k], orbit.pixel[k]) && on_detector(other.offset[k], orbit.offset[k]))
        && test.geometry.detector == train.geometry.detector
        && test.geometry.volume == train.geometry.volume;
    let expected = "the orbit, detector and grid of the training views";
    ensure(same, place, "test views", "another geometry", expected)?;
    Ok((orbit, Some(other)))
}

/// The orbit as formats with a key for the beam write it: the word for the beam, source to axis, source to detector, and
/// the detector's pixels and shift along v and u. A parallel beam has them at the axis, and distances that lie outside
/// `volume`.
pub(crate) fn written(orbit: &CircularOrbit, volume: &VoxelGrid) -> (&'static str, [f64; 2], [[f64; 2]; 2]) {
    match orbit.beam(volume) {
        Beam::Cone => ("cone", [orbit.dso, orbit.dsd], [orbit.pixel, orbit.offset]),
        Beam::Parallel => {
            let (pixel, offset) = orbit.at_axis();
            let away = orbit.dsd - orbit.dso;
            ("parallel", [away, 2.0 * away], [pixel, offset])
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::scan;
    use crate::{naf, r2};
    use conefield_core::geometry::{norm, sub};

    #[test]
    fn a_parallel_beam_comes_back_from_every_format() {
        let dir = tempfile::tempdir().unwrap();
        let mut train = scan();
        let angles = vec![0.3, 0.9, 1.4, 1.9, 2.4, 2.9, 3.3];
        let orbit = CircularOrbit::parallel(&train.geometry.volume, [2.0, 1.5], [-1.0, 30.0], angles);
        train.geometry.views = orbit.views();
        let (_, test) = train.split(&[1, 4]).unwrap();
        let [folder, file] = ["r2", "scan.pickle"].map(|name| dir.path().join(name));
        r2::write_r2(&folder, &train, Some(&test), None).unwrap();
        naf::write_naf(&file, &train, Some(&test), None).unwrap();
        let meta = std::fs::read_to_string(folder.join("meta_data.json")).unwrap();
        assert!(meta.contains("\"mode\": \"parallel\""), "{meta}");
        for back in [r2::read(&folder, true).unwrap(), naf::read(&file, true).unwrap()] {
            let g = &back.train.geometry;
            for view in 0..7 {
                assert!(g.is_parallel(view));
                for (row, column) in [(0, 0), (3, 5)] {
                    let [a, b] = [g, &train.geometry].map(|g| g.ray(view, row, column));
                    let apart = [norm(sub(a.origin, b.origin)), norm(sub(a.direction, b.direction))];
                    assert!(apart[0] < 1e-4 && apart[1] < 1e-9, "{view}: {apart:?}");
                }
            }
            assert!(back.test.unwrap().geometry.is_parallel(0));
        }
    }
}
