//! The geometry in a NeXus file of CIL's `NEXUSDataWriter`: cone beam, rotating object.
//!
//! Source of the layout: CIL (`cil.io.NEXUSDataReader`). Source of the direction of rotation: CIL's conversion to
//! ASTRA's vectors, in which source and detector rotate about the object by minus the angle. CIL names no unit of
//! length; conefield uses mm.

use super::turning::TurningObject;
use crate::hdf5::Container;
use conefield_core::geometry::{Vec3, View, norm};
use conefield_core::{Error, Result};
use std::path::Path;

const ENTRY: &str = "entry1/tomo_entry";

/// The views, one per angle of the file.
pub(super) fn views(path: &Path) -> Result<Vec<View>> {
    let file = Container::open(path)?;
    let data = file.needed(&format!("{ENTRY}/data/data"))?;
    let config = |name: &str| format!("{ENTRY}/config/{name}");
    if file.data(&config("source/position")).is_none() {
        let what = format!("{}: {} without source/position", path.display(), config(""));
        return Err(Error::unsupported(what, "a cone beam is read: parallel beams and files of CIL before 21 are not"));
    }
    let vector = |names: &[&str]| -> Result<Vec3> {
        let name = names.iter().map(|n| config(n)).find(|n| file.data(n).is_some()).unwrap_or_else(|| config(names[0]));
        let values = file.small(&file.needed(&name)?)?;
        <[f64; 3]>::try_from(values.as_slice())
            .ok()
            .filter(|v| v.iter().all(|x| x.is_finite()))
            .ok_or_else(|| file.invalid(&name, format!("{values:?}"), "three finite numbers"))
    };
    let direction = |names: &[&str]| {
        let found = vector(names)?;
        match norm(found) {
            n if n.is_finite() && n > 0.0 => Ok(found.map(|x| x / n)),
            _ => Err(file.invalid(&config(names[0]), format!("{found:?}"), "a direction")),
        }
    };
    let size = |name: &str| {
        let found = file.number_attribute(&data, name);
        found.filter(|x| *x > 0.0).ok_or_else(|| {
            let shown = found.map_or("nothing".to_owned(), |x| x.to_string());
            file.invalid(&format!("{} @{name}", data.name()), shown, "a positive length")
        })
    };
    let origin = file.text_attribute(&data, "panel_origin").unwrap_or_else(|| "bottom-left".into());
    let sign = |side: &str| if origin.contains(side) { -1.0 } else { 1.0 };
    let [x, y] = [
        direction(&["detector/direction_x", "detector/direction_row"])?,
        direction(&["detector/direction_y", "detector/direction_col"])?,
    ];
    let [column, row] = [sign("right") * size("pixel_size_h")?, sign("top") * size("pixel_size_v")?];
    let rest = TurningObject {
        source: vector(&["source/position"])?,
        detector: vector(&["detector/position"])?,
        u: x.map(|c| c * column),
        v: y.map(|c| c * row),
        axis: vector(&["rotation_axis/position"])?,
        axis_direction: direction(&["rotation_axis/direction"])?,
    };
    let angles = file.needed(&config("angles"))?;
    let radians = file.text_attribute(&angles, "angle_unit").is_some_and(|u| u.starts_with("rad"));
    let degrees = |a: f64| if radians { a.to_degrees() } else { a };
    let first = degrees(file.number_attribute(&angles, "initial_angle").unwrap_or(0.0));
    let all = file.small(&angles)?;
    if let Some(a) = all.iter().find(|a| !a.is_finite()) {
        return Err(file.invalid(angles.name(), a, "finite angles"));
    }
    Ok(rest.views(all.into_iter().map(|a| -first - degrees(a))))
}
