//! The programs of Gaussians on a device, put together from the pieces in `kernels`.

use super::super::ssim;
use conefield_core::device::{Access, Launch, Program, Source, fragment_of};
use conefield_core::error::Result;
use conefield_core::loss::Loss;
use conefield_core::prior::Prior;
use conefield_core::stage::titled;
use conefield_core::wgsl::TOTAL;
use std::f64::consts::TAU;

/// A piece of a program.
macro_rules! piece {
    ($name:literal) => {
        ($name, include_str!(concat!("../kernels/", $name, ".wgsl")))
    };
}

/// The type of a buffer in WGSL.
fn kind(buffer: &str) -> &'static str {
    match buffer {
        "view" => "View",
        "bins" => "Bins",
        "grid" => "Grid",
        "rule" => "Rule",
        "shapes" => "array<Shape>",
        "seen" => "array<Footprint>",
        "boxes" => "array<vec4<u32>>",
        "moments" => "array<vec4<f32>>",
        "partial" | "pulls" => "array<vec2<f32>>",
        "rays" => "array<LineRay>",
        "counts" | "starts" | "next" | "entries" | "stats" => "array<u32>",
        _ => "array<f32>",
    }
}

/// A program that reads uniform values and buffers, and writes others. `atomic NAME` is the buffer NAME of atomic numbers.
fn program(label: &str, uniforms: &[&str], read: &[&str], write: &[&str], pieces: &[(&str, &str)]) -> Program {
    let mut source = Source::default();
    for (names, access) in [(uniforms, Access::Uniform), (read, Access::Read), (write, Access::Write)] {
        for name in names {
            match name.strip_prefix("atomic ") {
                Some(name) => source.bind(name, access, "array<atomic<u32>>"),
                None => source.bind(name, access, kind(name)),
            }
        }
    }
    pieces.iter().for_each(|(name, text)| source.add(name, text));
    Program { label: format!("gaussians: {label}"), source }
}

/// Programs for values and line integrals, and the lists of all.
pub struct Evaluation {
    pub decode: Program,
    pub count: Program,
    pub scan: Program,
    pub fill: Program,
    pub reach: Program,
    pub paint: Program,
    pub at_points: Program,
    pub lines: Program,
}

impl Evaluation {
    pub fn new() -> Self {
        let constants = constants();
        let visiting = |label, write: &[&str], visit: &str| {
            let visit = piece!("visit").1.replace("VISIT", visit);
            program(label, &["bins"], &["boxes"], write, &[piece!("bins"), (label, &*visit)])
        };
        let shape = piece!("shape");
        Self {
            decode: program("decode", &[], &["params"], &["shapes"], &[shape, piece!("quaternion"), piece!("decode")]),
            // The counts are zero before, and again after the scan.
            count: visiting("count", &["atomic counts"], "atomicAdd(&counts[bin], 1u);"),
            scan: program("scan", &["bins"], &[], &["counts", "starts", "next"], &[piece!("bins"), piece!("scan")]),
            // Lists in any order. Where there is no room, the host sees it and repeats the work.
            fill: visiting(
                "fill",
                &["atomic next", "entries"],
                "let at = atomicAdd(&next[bin], 1u);
                    if at < bins.room { entries[at] = i; }",
            ),
            reach: program("reach", &["grid"], &["shapes"], &["boxes"], &[shape, piece!("grid"), piece!("reach")]),
            paint: program(
                "paint",
                &["bins", "grid"],
                &["shapes", "starts", "entries"],
                &["values"],
                &[shape, piece!("bins"), piece!("grid"), piece!("paint")],
            ),
            at_points: program(
                "at points",
                &["bins", "grid"],
                &["shapes", "starts", "entries", "points"],
                &["values"],
                &[shape, piece!("bins"), piece!("grid"), piece!("at_points")],
            ),
            lines: program(
                "lines",
                &["grid"],
                &["shapes", "rays"],
                &["values"],
                &[shape, piece!("grid"), ("constants", &constants), piece!("lines")],
            ),
        }
    }

    /// From boxes to lists, by `each` groups for the slots.
    pub fn lists(&self, each: usize) -> [Launch<'_>; 3] {
        [(&self.count, each), (&self.scan, 1), (&self.fill, each)]
    }

    /// All programs.
    pub fn all(&self) -> [&Program; 8] {
        [&self.decode, &self.count, &self.scan, &self.fill, &self.reach, &self.paint, &self.at_points, &self.lines]
    }
}

/// Programs of a training step.
pub struct Training {
    pub look: Program,
    pub project: Program,
    /// Structural similarity: rows of the images, similarity, rows of its derivatives, derivatives. Empty without it.
    pub ssim: Vec<Program>,
    pub gather: Program,
    pub learn_view: Program,
    pub finish_view: Program,
    /// Of each prior: its penalty.
    pub penalties: Vec<Program>,
    pub collect: Program,
    pub learn_block: Program,
    pub finish_block: Program,
    pub adam: Program,
}

impl Training {
    /// Refuses a loss or prior without WGSL.
    pub fn new(loss: &dyn Loss, priors: &[Box<dyn Prior>], ssim: bool) -> Result<Self> {
        let constants = constants();
        let (shape, quaternion, view) = (piece!("shape"), piece!("quaternion"), piece!("view"));
        let (bins, grid, constants) = (piece!("bins"), piece!("grid"), ("constants", &*constants));
        let (footprint, moments, ray) = (piece!("footprint"), piece!("moments"), piece!("ray_length"));
        let total = ("total", TOTAL);
        let name = titled("loss", &loss.describe());
        let loss = fragment_of(&name, loss.wgsl())?.named("loss_");
        let with_ssim = ("constants", &*format!("const SSIM = {ssim};"));
        Ok(Self {
            look: program(
                "look",
                &["view"],
                &["shapes"],
                &["seen", "boxes"],
                &[shape, view, constants, footprint, piece!("look")],
            ),
            project: program(
                "project",
                &["view", "bins"],
                &["seen", "starts", "entries", "wanted"],
                &["found", "gradient", "partial"],
                &[view, shape, bins, footprint, ray, total, with_ssim, (&*name, &*loss), piece!("project")],
            ),
            ssim: if ssim { self::ssim() } else { vec![] },
            gather: program(
                "gather",
                &["view"],
                &["boxes", "seen", "gradient"],
                &["moments"],
                &[view, shape, footprint, moments, piece!("gather")],
            ),
            learn_view: program(
                "learn view",
                &["view"],
                &["shapes", "boxes", "moments", "params"],
                &["grads"],
                &[shape, quaternion, view, constants, piece!("learn"), piece!("learn_view")],
            ),
            finish_view: finish(
                "finish view",
                &["bins", "view"],
                &[bins, shape, view],
                "let before = select(vec4<u32>(stats[0], stats[1], stats[2], stats[3]), vec4<u32>(), view.opens == 1u);
        stats[0] = bitcast<u32>(bitcast<f32>(before.x) + all[0].x);
        stats[1] = bitcast<u32>(bitcast<f32>(before.y) + all[0].y);
        stats[2] = before.z;
        stats[3] = max(before.w, starts[bins.count]);",
            ),
            penalties: penalties(priors)?,
            collect: program(
                "collect",
                &["grid"],
                &["boxes", "shapes", "by"],
                &["moments"],
                &[shape, grid, moments, piece!("collect")],
            ),
            learn_block: program(
                "learn block",
                &[],
                &["shapes", "boxes", "moments", "params"],
                &["grads"],
                &[shape, quaternion, piece!("learn"), piece!("learn_block")],
            ),
            finish_block: finish(
                "finish block",
                &["bins"],
                &[bins],
                "stats[2] = bitcast<u32>(bitcast<f32>(stats[2]) + all[0].x);
        stats[3] = max(stats[3], starts[bins.count]);",
            ),
            adam: program(
                "adam",
                &["rule"],
                &["grads"],
                &["params", "first", "second", "pulls"],
                &[quaternion, piece!("adam")],
            ),
        })
    }

    /// All programs.
    pub fn all(&self) -> impl Iterator<Item = &Program> {
        let Self { look, project, gather, learn_view, finish_view, collect, learn_block, finish_block, adam, .. } =
            self;
        let fixed = [look, project, gather, learn_view, finish_view, collect, learn_block, finish_block, adam];
        fixed.into_iter().chain(&self.ssim).chain(&self.penalties)
    }
}

/// Adds up the partial sums of a view or block: `body` adds `all[0]` to the statistics of a step.
fn finish(label: &str, uniforms: &[&str], pieces: &[(&str, &str)], body: &str) -> Program {
    let body = piece!("finish").1.replace("FINISH", body);
    program(label, uniforms, &["partial", "starts"], &["stats"], &[pieces, &[("finish", &*body)]].concat())
}

/// The penalties of the priors. Refuses one without WGSL.
fn penalties(priors: &[Box<dyn Prior>]) -> Result<Vec<Program>> {
    let all = priors.iter().enumerate().map(|(i, prior)| {
        let name = titled("prior", &prior.describe());
        let edge = format!("const prior_edge = {}u;", prior.blocks().edge);
        let text = fragment_of(&name, prior.wgsl())?.named("prior_");
        let pieces = [piece!("grid"), ("total", TOTAL), ("blocks", &*edge), (&*name, &*text), piece!("penalty")];
        Ok(program(&format!("penalty {i}"), &["grid"], &["values"], &["by", "partial"], &pieces))
    });
    all.collect()
}

/// The programs of structural similarity.
fn ssim() -> Vec<Program> {
    let (shape, view, total) = (piece!("shape"), piece!("view"), ("total", TOTAL));
    let taps = ssim::window().map(|tap| format!("{tap:e}")).join(", ");
    let taps = format!("var<private> taps: array<f32, 11> = array<f32, 11>({taps});");
    let taps = ("taps", &*taps);
    let rows = |maps: &str, take: &str| piece!("blur_rows").1.replace("MAPS", maps).replace("TAKE", take);
    let columns = |maps: &str| piece!("blur_columns").1.replace("MAPS", maps);
    let of_images = rows(
        "5",
        "let x = found[at];
                let y = wanted[at];
                sums[0] += tap * x;
                sums[1] += tap * y;
                sums[2] += tap * x * x;
                sums[3] += tap * y * y;
                sums[4] += tap * x * y;",
    );
    let of_slopes = rows("3", "for (var m = 0u; m < 3u; m++) { sums[m] += tap * slopes[m * pixels + at]; }");
    let [five, three] = ["5", "3"].map(columns);
    vec![
        program("blur", &["view"], &["found", "wanted"], &["between"], &[shape, view, taps, ("rows", &of_images)]),
        program(
            "similarity",
            &["view"],
            &["between"],
            &["slopes", "partial"],
            &[shape, view, taps, total, ("columns", &five), piece!("similarity")],
        ),
        program("blur slopes", &["view"], &["slopes"], &["between"], &[shape, view, taps, ("rows", &of_slopes)]),
        program(
            "dissimilar",
            &["view"],
            &["between", "found", "wanted"],
            &["gradient"],
            &[shape, view, taps, piece!("ray_length"), ("columns", &three), piece!("dissimilar")],
        ),
    ]
}

/// Constants of the CPU's modules.
fn constants() -> String {
    let cut = super::super::view::EXTENT.powi(2);
    format!("const ROOT_TAU = {:e};\nconst LINE_CUT = {cut:e};\n", TAU.sqrt())
}
