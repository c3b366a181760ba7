//! Properties of an initializer: it fills what it reports, with finite numbers, reproducibly, and nothing else.

use crate::Report;
use crate::call::{Draw, differing, require, settle};
use conefield_core::arena::{Arena, Block, InitReport, Layout};
use conefield_core::error::Result;
use conefield_core::settings::Initializer;

/// Checks all properties of an initializer, on the layout of a small pipeline.
pub fn check_initializer(initializer: &dyn Initializer) -> Report {
    let mut report = Report::of(initializer.describe());
    let layout = layout();
    let run = |seed| run(initializer, &layout, seed);
    report.add("applies", || {
        let (n, (_, found)) = (layout.blocks.len(), run(5)?);
        let reported = found.loaded.len() + found.fresh.len();
        require(reported == n, || format!("it reports {reported} of {n} blocks"))?;
        Ok(format!("{} of {n} blocks filled", found.loaded.len()))
    });
    report.add("fills", || {
        let (runs, blocks) = ([run(5)?, run(6)?], &layout.blocks);
        // By chance, a number may be as it was in one run.
        let left = |&i: &usize| runs.iter().all(|([before, after], _)| before[i] == after[i]);
        let mut filled = blocks.iter().filter(|b| runs[0].1.loaded.contains(&b.name));
        let hole = filled.find_map(|b| Some((b, b.range.clone().find(left)? - b.range.start)));
        let complaint = hole.map(|(b, i)| format!("{} is filled, but for number {i} of {}", b.name, b.range.len()));
        settle(complaint, "every number of these blocks")
    });
    report.add("finite", || {
        let bad = run(5)?.0[1].iter().position(|v| !v.is_finite());
        settle(bad.map(|i| format!("parameter {i}")), "every parameter")
    });
    report.add("repeatable", || settle(differing("parameter", &run(5)?.0[1], &run(5)?.0[1]), "the same bits twice"));
    report.add("leaves the rest alone", || {
        let ([before, after], found) = run(5)?;
        let mut rest = layout.blocks.iter().filter(|b| !found.loaded.contains(&b.name));
        let complaint = rest.find_map(|b| differing(&b.name, &after[b.range.clone()], &before[b.range.clone()]));
        settle(complaint, "blocks that it does not report keep their bits")
    });
    report
}

fn layout() -> Layout {
    let mut blocks = vec![];
    let mut at = 0;
    let shapes: [(&str, &[usize]); 6] = [
        ("encoder.0.table", &[300, 2]),
        ("encoder.1.table", &[64, 2]),
        ("normalizers.0.weight", &[4]),
        ("normalizers.0.bias", &[4]),
        ("field.0.weight", &[8, 4]),
        ("field.0.bias", &[8]),
    ];
    for (name, shape) in shapes {
        let n: usize = shape.iter().product();
        blocks.push(Block { name: name.into(), shape: shape.to_vec(), range: at..at + n });
        at += n;
    }
    Layout { blocks }
}

/// Parameters before and after the initializer, and what it reports.
fn run(initializer: &dyn Initializer, layout: &Layout, seed: u64) -> Result<([Vec<f32>; 2], InitReport)> {
    let before: Vec<f32> = Draw::new(seed, 5).many(&(-0.1..0.1), layout.len());
    let mut arena = Arena::new(layout.len());
    arena.params.copy_from_slice(&before);
    let report = initializer.apply(layout, &mut arena)?;
    Ok(([before, arena.params.to_vec()], report))
}
