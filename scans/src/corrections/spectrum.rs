//! The spectrum of an X-ray tube and its absorption by water and aluminium.

/// Photon energies in keV and mass attenuation coefficients of water in cm²/g (J. H. Hubbell and S. M. Seltzer, NIST
/// Standard Reference Database 126, NISTIR 5632, table 4). Interpolation is logarithmic.
pub const WATER: [[f64; 2]; 21] = [
    [5.0, 42.58],
    [6.0, 24.64],
    [8.0, 10.37],
    [10.0, 5.329],
    [15.0, 1.673],
    [20.0, 0.8096],
    [30.0, 0.3756],
    [40.0, 0.2683],
    [50.0, 0.2269],
    [60.0, 0.2059],
    [80.0, 0.1837],
    [100.0, 0.1707],
    [150.0, 0.1505],
    [200.0, 0.1370],
    [300.0, 0.1186],
    [400.0, 0.1061],
    [500.0, 0.09687],
    [600.0, 0.08956],
    [800.0, 0.07865],
    [1000.0, 0.07072],
    [1250.0, 0.06323],
];
/// The same of aluminium, from 10 keV on (table 3).
const OF_ALUMINIUM: [f64; 14] =
    [26.23, 7.955, 3.441, 1.128, 0.5685, 0.3681, 0.2778, 0.2018, 0.1704, 0.1378, 0.1223, 0.1042, 0.09276, 0.08445];
/// Index of 10 keV in the table of water.
const LOWEST: usize = 3;
/// Lowest and highest tube voltage that the table covers, in kV.
pub(crate) const VOLTAGES: [f64; 2] = [20.0, 500.0];
/// Density of aluminium in g/cm³.
const ALUMINIUM: f64 = 2.699;
/// Number of energies in a spectrum.
const STEPS: usize = 100;

/// Attenuation of water in 1/mm and the share of the detector's signal, for each energy.
pub(crate) struct Spectrum {
    lines: Vec<[f64; 2]>,
}

impl Spectrum {
    /// Bremsstrahlung of a tube at `kvp` kV through `aluminium` mm of filter, on a detector that sums energies:
    /// Kramers' law gives (E₀ − E)/E photons of energy E, and each contributes E.
    pub fn of_tube(kvp: f64, aluminium: f64) -> Self {
        let lowest = WATER[LOWEST][0];
        let line = |i: usize| {
            let energy = lowest + (kvp - lowest) * (i as f64 + 0.5) / STEPS as f64;
            let [of_water, of_filter] = attenuation(energy);
            let through = (-of_filter * ALUMINIUM * aluminium / 10.0).exp();
            [of_water / 10.0, (kvp - energy) * through]
        };
        let mut lines: Vec<[f64; 2]> = (0..STEPS).map(line).collect();
        let sum: f64 = lines.iter().map(|l| l[1]).sum();
        lines.iter_mut().for_each(|l| l[1] /= sum);
        Self { lines }
    }

    /// The attenuation of a thin layer of water in 1/mm.
    pub fn thin(&self) -> f64 {
        self.lines.iter().map(|[mu, share]| mu * share).sum()
    }

    /// The measured line integral of `length` mm of water.
    pub fn measured(&self, length: f64) -> f64 {
        -self.lines.iter().map(|[mu, share]| share * (-mu * length).exp()).sum::<f64>().ln()
    }
}

/// The mass attenuation of water and of aluminium at `energy`, in cm²/g.
fn attenuation(energy: f64) -> [f64; 2] {
    let table = &WATER[LOWEST..][..OF_ALUMINIUM.len()];
    let above = table.iter().position(|l| l[0] > energy).unwrap_or(table.len() - 1).max(1);
    let ([low, of_low], [high, of_high]) = (table[above - 1], table[above]);
    let share = (energy / low).ln() / (high / low).ln();
    [[of_low, of_high], [OF_ALUMINIUM[above - 1], OF_ALUMINIUM[above]]]
        .map(|[low, high]| low * (high / low).powf(share))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn harder_beams_are_absorbed_less() {
        for (energy, [water, aluminium]) in [(60.0, [0.2059, 0.2778]), (500.0, [0.09687, 0.08445])] {
            let found = attenuation(energy);
            assert!((found[0] - water).abs() < 1e-12 && (found[1] - aluminium).abs() < 1e-12, "{found:?}");
        }
        // NIST has 0.1929 at 70 keV; this value is interpolated.
        assert!((attenuation(70.0)[0] - 0.1929).abs() < 2e-3);
        let [soft, filtered, hard] =
            [(80.0, 1.0), (80.0, 5.0), (140.0, 1.0)].map(|(kvp, al)| Spectrum::of_tube(kvp, al).thin());
        assert!(
            soft > filtered && soft > hard && filtered.min(hard) > 0.015 && soft < 0.06,
            "{soft} {filtered} {hard}"
        );
        let s = Spectrum::of_tube(120.0, 2.5);
        assert!(s.measured(0.0).abs() < 1e-12 && (s.measured(1e-3) / 1e-3 / s.thin() - 1.0).abs() < 1e-3);
        // 20 cm of water: about 15 % less than without hardening.
        let share = s.measured(200.0) / (200.0 * s.thin());
        assert!((0.7..0.95).contains(&share), "{share}");
    }
}
