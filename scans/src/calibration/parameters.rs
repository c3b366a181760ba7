//! The parameters of a geometry that can be corrected, and the corrected views.

use conefield_core::Error;
use conefield_core::geometry::{Geometry, Radians, Vec3, View, norm};
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;
use std::fmt;
use std::str::FromStr;

/// One number of a scan's geometry that its own views can determine.
///
/// They cannot determine the distance from source to axis: an object twice as large and twice as far from the source
/// gives the same views. Nor can they determine the angle of the first view, which only rotates the object.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Parameter {
    /// Shift of the detector along u (the direction of the column index): the centre of rotation.
    OffsetU,
    /// Shift of the detector along v (the direction of the row index).
    OffsetV,
    /// Rotation of the detector in its own plane: about u × v, right-handed.
    Rotation,
    /// Rotation of the detector about u.
    Tilt,
    /// Rotation of the detector about v.
    Slant,
    /// Shift of the detector away from the source: the distance from source to detector.
    Distance,
    /// Relative error of the angles between views.
    Step,
}

impl Parameter {
    /// All of them.
    pub const ALL: [Self; 7] =
        [Self::OffsetU, Self::OffsetV, Self::Rotation, Self::Tilt, Self::Slant, Self::Distance, Self::Step];

    /// Its name on the command line and in results.
    pub fn name(self) -> &'static str {
        match self {
            Self::OffsetU => "offset-u",
            Self::OffsetV => "offset-v",
            Self::Rotation => "rotation",
            Self::Tilt => "tilt",
            Self::Slant => "slant",
            Self::Distance => "distance",
            Self::Step => "step",
        }
    }

    /// Whether pairs of views determine it, instead of the prediction of held-out views.
    pub fn by_pairs(self) -> bool {
        matches!(self, Self::OffsetV | Self::Tilt | Self::Distance | Self::Step)
    }

    /// Its unit in results.
    pub fn unit(self) -> &'static str {
        match self {
            Self::OffsetU | Self::OffsetV | Self::Distance => "mm",
            Self::Rotation | Self::Tilt | Self::Slant => "deg",
            Self::Step => "%",
        }
    }

    /// The factor from a [`Correction`] to [`Parameter::unit`].
    pub fn in_unit(self) -> f64 {
        match self {
            Self::OffsetU | Self::OffsetV | Self::Distance => 1.0,
            Self::Rotation | Self::Tilt | Self::Slant => 1f64.to_degrees(),
            Self::Step => 100.0,
        }
    }

    /// The change that moves shadows at the side of the detector by about a pixel of `geometry` relative to each other.
    /// An equal shift of all shadows along v is a shift of the object; only the larger shift of parts near the source
    /// is evidence of the detector.
    pub fn pixel(self, geometry: &Geometry) -> f64 {
        let view = &geometry.views[0];
        let [v, u] = [norm(view.v), norm(view.u)];
        let half = [v, u].iter().zip(geometry.detector).map(|(p, n)| p * n as f64 / 2.0).fold(0.0, f64::max);
        let pixel = u.max(v);
        let depth = view.normal().1;
        match self {
            Self::OffsetU => u,
            Self::Rotation => pixel / half,
            Self::Tilt | Self::Slant => pixel * depth / (half * half),
            Self::OffsetV => pixel * depth / half,
            // A larger distance enlarges all shadows, like a larger object. Only the stronger growth of near parts is
            // evidence.
            Self::Distance => pixel * (depth / half).powi(2),
            Self::Step => {
                let turns = turns(&geometry.views);
                let arc = turns.iter().fold(0.0f64, |most, a| most.max(a.abs()));
                pixel / (half * arc.max(1e-3))
            }
        }
    }
}

impl fmt::Display for Parameter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Parameter {
    type Err = Error;
    fn from_str(text: &str) -> Result<Self, Error> {
        let names = Self::ALL.map(Self::name).join(", ");
        let found = Self::ALL.into_iter().find(|p| p.name() == text);
        found.ok_or_else(|| {
            let why = match text {
                "dso" => " (the distance from source to axis goes with the object's size, which a scan does not show)",
                _ => "",
            };
            Error::invalid("command line", "parameter", format!("\"{text}\"{why}"), format!("one of {names}"))
        })
    }
}

/// A change of a geometry: a number for each [`Parameter`], in mm, radians and, for the step, as a share.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Correction([f64; Parameter::ALL.len()]);

impl Correction {
    /// The change of one parameter.
    pub fn get(&self, parameter: Parameter) -> f64 {
        self.0[parameter as usize]
    }

    /// The same with another change of one parameter.
    pub fn with(mut self, parameter: Parameter, value: f64) -> Self {
        self.0[parameter as usize] = value;
        self
    }

    /// The corrected views of a scan: rotates the views about z by the step, then shifts the detectors along their own
    /// axes, then rotates them about their centres.
    pub fn views(&self, views: &[View]) -> Vec<View> {
        let get = |p| self.get(p);
        let angles = [get(Parameter::Tilt), get(Parameter::Slant), get(Parameter::Rotation)].map(Radians);
        let corrected = |(view, turn): (&View, f64)| {
            let View { source, detector, u, v } = turned(view, get(Parameter::Step) * turn);
            let ahead = View { source, detector, u, v }.normal().0;
            let shift = |k: usize| {
                get(Parameter::OffsetU) * u[k] / norm(u)
                    + get(Parameter::OffsetV) * v[k] / norm(v)
                    + get(Parameter::Distance) * ahead[k]
            };
            View { source, detector: std::array::from_fn(|k| detector[k] + shift(k)), u, v }.tilted(angles)
        };
        views.iter().zip(turns(views)).map(corrected).collect()
    }
}

/// Angles of the sources relative to the first one, without jumps of more than half a turn.
fn turns(views: &[View]) -> Vec<f64> {
    let angle = |v: &View| v.source[1].atan2(v.source[0]);
    let Some(first) = views.first().map(angle) else { return vec![] };
    let mut last = 0.0f64;
    let follow = |v: &View| {
        let a = angle(v) - first;
        last = a + ((last - a) / TAU).round() * TAU;
        last
    };
    views.iter().map(follow).collect()
}

/// A view rotated about z.
fn turned(view: &View, angle: f64) -> View {
    if angle == 0.0 {
        return *view;
    }
    let (s, c) = angle.sin_cos();
    let turn = |a: Vec3| [c * a[0] - s * a[1], s * a[0] + c * a[1], a[2]];
    View { source: turn(view.source), detector: turn(view.detector), u: turn(view.u), v: turn(view.v) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_core::orbit::CircularOrbit;

    fn orbit(offset: [f64; 2], dsd: f64, range: f64) -> Vec<View> {
        let angles = (0..9).map(|i| 0.2 + range * f64::from(i) / 9.0).collect();
        CircularOrbit { dso: 100.0, dsd, pixel: [1.0, 2.0], offset, angles }.views()
    }

    fn near(a: &[View], b: &[View]) {
        for (a, b) in a.iter().zip(b) {
            for (x, y) in [(a.source, b.source), (a.detector, b.detector), (a.u, b.u), (a.v, b.v)] {
                assert!((0..3).all(|k| (x[k] - y[k]).abs() < 1e-9), "{a:?} {b:?}");
            }
        }
    }

    #[test]
    fn a_correction_gives_the_expected_circle() {
        let start = orbit([1.0, -2.0], 150.0, TAU);
        assert_eq!(Correction::default().views(&start), start);
        let moved = Correction::default()
            .with(Parameter::OffsetV, 0.5)
            .with(Parameter::OffsetU, 3.0)
            .with(Parameter::Distance, 10.0)
            .with(Parameter::Step, 0.01);
        near(&moved.views(&start), &orbit([1.5, 1.0], 160.0, 1.01 * TAU));
    }

    #[test]
    fn angles_continue_beyond_a_full_turn() {
        let views = orbit([0.0; 2], 150.0, 2.0 * TAU);
        let found = turns(&views);
        assert!(found.iter().enumerate().all(|(i, a)| (a - 2.0 * TAU * i as f64 / 9.0).abs() < 1e-9), "{found:?}");
        let back: Vec<View> = views.into_iter().rev().collect();
        assert!(turns(&back)[8] < -10.0);
    }

    #[test]
    fn names_are_parsed_and_others_refused() {
        for p in Parameter::ALL {
            assert_eq!(p.name().parse::<Parameter>().unwrap(), p);
        }
        let e = "dso".parse::<Parameter>().unwrap_err().to_string();
        assert!(e.contains("object's size") && e.contains("offset-u"), "{e}");
    }
}
