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
    report.add("applies", || {
        let (n, (_, found)) = (layout.blocks.len(), run(initializer, &layout)?);
        let reported = found.loaded.len() + found.fresh.len();
        require(reported == n, || format!("it reports {reported} of {n} blocks"))?;
        Ok(format!("{} of {n} blocks filled", found.loaded.len()))
    });
    report.add("finite", || {
        let bad = run(initializer, &layout)?.0.iter().position(|v| !v.is_finite());
        settle(bad.map(|i| format!("parameter {i}")), "every parameter")
    });
    report.add("repeatable", || {
        let ((a, _), (b, _)) = (run(initializer, &layout)?, run(initializer, &layout)?);
        settle(differing("parameter", &a, &b), "the same bits twice")
    });
    report.add("leaves the rest alone", || {
        let ((p, found), before) = (run(initializer, &layout)?, start(&layout));
        let mut rest = layout.blocks.iter().filter(|b| !found.loaded.contains(&b.name));
        let complaint = rest.find_map(|b| differing(&b.name, &p[b.range.clone()], &before[b.range.clone()]));
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

fn start(layout: &Layout) -> Vec<f32> {
    Draw::new(5, 5).many(&(-0.1..0.1), layout.len())
}

fn run(initializer: &dyn Initializer, layout: &Layout) -> Result<(Vec<f32>, InitReport)> {
    let mut arena = Arena::new(layout.len());
    arena.params.copy_from_slice(&start(layout));
    let report = initializer.apply(layout, &mut arena)?;
    Ok((arena.params.to_vec(), report))
}
