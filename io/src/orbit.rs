//! The circular orbit that some formats require.

use conefield_core::error::ensure;
use conefield_core::orbit::CircularOrbit;
use conefield_core::scan::Scan;
use conefield_core::{Error, Result};

/// The orbits of `train` and `test` for a `format` that supports only circles, the same for both scans. Refuses
/// anything else, and a test scan with another detector or grid.
pub(crate) fn common_orbit(
    place: &str,
    format: &str,
    train: &Scan,
    test: Option<&Scan>,
) -> Result<(CircularOrbit, Option<CircularOrbit>)> {
    let fit = |name: &str, s: &Scan| -> Result<CircularOrbit> {
        s.validate(&format!("{place}: {name}"))?;
        CircularOrbit::fit(&s.geometry.views).ok_or_else(|| {
            let why = format!("{format} only knows circles about z; write conefield's own format");
            Error::unsupported(format!("{place}: {name} views that are not one circle"), why)
        })
    };
    let orbit = fit("training", train)?;
    let Some(test) = test else { return Ok((orbit, None)) };
    let other = fit("test", test)?;
    let near = |a: f64, b: f64| (a - b).abs() <= 1e-6 * orbit.dsd;
    let same = near(other.dso, orbit.dso)
        && near(other.dsd, orbit.dsd)
        && (0..2).all(|k| near(other.pixel[k], orbit.pixel[k]) && near(other.offset[k], orbit.offset[k]))
        && test.geometry.detector == train.geometry.detector
        && test.geometry.volume == train.geometry.volume;
    let expected = "the orbit, detector and grid of the training views";
    ensure(same, place, "test views", "another geometry", expected)?;
    Ok((orbit, Some(other)))
}
