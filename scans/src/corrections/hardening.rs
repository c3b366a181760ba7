//! Beam hardening: soft X-rays are absorbed first, so thick paths seem to absorb too little.

use crate::corrections::Correct;
use crate::corrections::spectrum::{Spectrum, VOLTAGES};
use conefield_core::error::{Error, Result, ensure};
use conefield_core::finite::range;
use conefield_core::scan::Scan;
use serde::{Deserialize, Serialize};

/// Number of table entries.
const NODES: usize = 4096;

/// Converts line integrals to a single energy. Exactly one of the two ways must be given.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Hardening {
    /// Factors of A, A², A³, ...: their sum replaces A (Herman, Phys. Med. Biol. 24(1), 1979). Measure them with a step
    /// wedge, or adjust them until a homogeneous part is as bright inside as at its rim.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub polynomial: Vec<f64>,
    /// The tube; the object is treated as water.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub water: Option<Water>,
}

/// The tube and its filter. The absorption of its spectrum by a length of water is computed and inverted (Joseph and
/// Spital, J. Comput. Assist. Tomogr. 2(1), 1978); thin paths keep their values.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Water {
    /// Tube voltage in kV.
    pub kvp: f64,
    /// Aluminium in the beam in mm, or the equivalent of another filter.
    #[serde(default = "filter")]
    pub aluminium: f64,
}

fn filter() -> f64 {
    2.5
}

impl Correct for Hardening {
    fn validate(&self) -> Result<()> {
        let p = &self.polynomial;
        let (one, found) = match (p.is_empty(), &self.water) {
            (true, None) => (false, "neither"),
            (false, Some(_)) => (false, "both"),
            _ => (true, ""),
        };
        let expected = "one of hardening.polynomial=[1.0, 0.05] and hardening.water.kvp=120";
        ensure(one, "spec", "polynomial and water", found, expected)?;
        ensure(p.iter().all(|x| x.is_finite()), "spec", "polynomial", format!("{p:?}"), "finite numbers")?;
        if let Some(Water { kvp, aluminium }) = self.water {
            let [low, high] = VOLTAGES;
            ensure((low..=high).contains(&kvp), "spec", "water.kvp", kvp, format!("{low} to {high} kV"))?;
            ensure((0.0..=100.0).contains(&aluminium), "spec", "water.aluminium", aluminium, "0 to 100 mm")?;
        }
        Ok(())
    }

    fn correct(&self, scan: &mut Scan) -> Result<String> {
        let most = range(&scan.projections)[1].max(0.0);
        match self.water {
            Some(water) => {
                let table = Table::of(water, most.into())?;
                scan.projections.par_mapv_inplace(|a| table.at(a));
            }
            None => {
                rising(&self.polynomial, most.into())?;
                scan.projections.par_mapv_inplace(|a| polynomial(&self.polynomial, a.into()) as f32);
            }
        }
        let now = range(&scan.projections)[1].max(0.0);
        Ok(format!("the largest line integral of {most:.3} became {now:.3}"))
    }
}

/// The polynomial; linear below 0, where there is only noise.
fn polynomial(factors: &[f64], a: f64) -> f64 {
    match a > 0.0 {
        true => factors.iter().rev().fold(0.0, |sum, c| (sum + c) * a),
        false => factors.first().copied().unwrap_or(0.0) * a,
    }
}

/// Refuses a polynomial that is not increasing: two thicknesses would give the same value.
fn rising(factors: &[f64], most: f64) -> Result<()> {
    let mut last = 0.0;
    for i in 1..=1000 {
        let a = most.max(1e-3) * f64::from(i) / 1000.0;
        let now = polynomial(factors, a);
        if now.is_nan() || now <= last {
            let found = format!("{factors:?}, which falls at a line integral of {a:.3}");
            let expected = format!("a polynomial that rises up to {most:.3}, the largest line integral of the scan");
            return Err(Error::invalid("spec", "polynomial", found, expected));
        }
        last = now;
    }
    Ok(())
}

/// The inverse of the measured line integral of water.
struct Table {
    /// Line integrals of a single energy at even steps of the measured ones.
    nodes: Vec<f32>,
    step: f64,
}

impl Table {
    /// The table for measured line integrals up to `most`.
    fn of(water: Water, most: f64) -> Result<Self> {
        let spectrum = Spectrum::of_tube(water.kvp, water.aluminium);
        let thin = spectrum.thin();
        let step = most.max(1e-3) / (NODES - 1) as f64;
        let mut nodes = Vec::with_capacity(NODES);
        let mut length = 0.0;
        for i in 0..NODES {
            let measured = step * i as f64;
            // Newton's steps from the last length; the measured integral is increasing and concave, so no step
            // overshoots.
            for _ in 0..50 {
                let off = measured - spectrum.measured(length);
                let small = 1e-4 / thin;
                let slope = (spectrum.measured(length + small) - spectrum.measured(length)) / small;
                length += off / slope;
                if off.abs() < 1e-9 * most.max(1.0) || !length.is_finite() {
                    break;
                }
            }
            let fits = length.is_finite() && thin * length <= 1e3;
            ensure(fits, "spec", "water.kvp", water.kvp, format!("a tube whose light passes water of A = {most:.3}"))?;
            nodes.push((thin * length) as f32);
        }
        Ok(Self { nodes, step })
    }

    fn at(&self, a: f32) -> f32 {
        if a <= 0.0 {
            return a;
        }
        let x = f64::from(a) / self.step;
        let i = (x as usize).min(NODES - 2);
        let (low, high) = (self.nodes[i], self.nodes[i + 1]);
        low + (high - low) * (x - i as f64) as f32
    }
}
