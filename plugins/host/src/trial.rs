//! A stage is tried out before any real work is handed to it: on a few rows, between guard zones, under a time limit. What
//! writes outside its tile, leaves outputs unwritten, returns numbers that are not finite, fails or does not come back is
//! refused here. Whether gradients are right only the conformance kit can say.

use crate::library::Type;
use conefield_core::error::{Error, Result};
use conefield_core::half::{Half, round};
use conefield_core::pages::Pages;
use conefield_core::random::{mix, unit};
use conefield_core::stage::{GradKind, Grads, Halves, Kernel, Reader, Stage, TILE_ROWS, Tile, TileMut, UnitRay};
use std::ops::Range;
use std::sync::mpsc;
use std::thread;
use std::time::Duration;

/// How long a trial may take.
pub const LIMIT: Duration = Duration::from_secs(5);

/// Numbers on either side of a buffer that nobody may write to: more than a tile of the widest common stages.
pub(crate) const GUARD: usize = 1 << 14;
/// A NaN that no arithmetic makes: the mark of what nobody has written to.
pub(crate) const UNTOUCHED: u32 = 0x7fc5_a7e1;

/// Stages of more parameters are not initialised for their trial; that takes long, and the run does it anyway.
const MANY: usize = 1 << 20;

/// A buffer between guard zones. What is only zeroed takes no memory until it is written to: a trial comes before what a run
/// would take is reckoned.
struct Guarded(Pages);

impl Guarded {
    fn new(n: usize) -> Self {
        let mut g = Self::zeroed(n);
        g.inner().fill(f32::from_bits(UNTOUCHED));
        g
    }

    fn inner(&mut self) -> &mut [f32] {
        let n = self.0.len();
        &mut self.0[GUARD..n - GUARD]
    }

    fn zeroed(n: usize) -> Self {
        let mut pages = Pages::zeros(n + 2 * GUARD);
        for zone in [0..GUARD, GUARD + n..n + 2 * GUARD] {
            pages[zone].fill(f32::from_bits(UNTOUCHED));
        }
        Self(pages)
    }

    /// What is wrong with the zones.
    fn broken(&self, what: &str) -> Option<String> {
        let n = self.0.len();
        let outside = (0..GUARD).chain(n - GUARD..n);
        let at = outside.into_iter().find(|&i| self.0[i].to_bits() != UNTOUCHED)?;
        let place =
            if at < GUARD { format!("{} before", GUARD - at) } else { format!("{} past", at - (n - GUARD) + 1) };
        Some(format!("it writes outside its {what}: {place} {} numbers", n - 2 * GUARD))
    }

    /// What is wrong with what was written.
    fn unsound(&mut self, what: &str) -> Option<String> {
        let n = self.inner().len();
        let all = self.inner().iter().enumerate();
        all.filter(|(_, v)| !v.is_finite())
            .map(|(i, v)| {
                let how = if v.to_bits() == UNTOUCHED { "is left unwritten".into() } else { format!("is {v}") };
                format!("number {i} of {n} of its {what} {how}")
            })
            .next()
    }
}

/// Makes something of a library under the time limit, on a thread of its own: one that hangs is left behind.
pub(crate) fn timed<T: Send + 'static>(ty: &Type, make: impl FnOnce() -> Result<T> + Send + 'static) -> Result<T> {
    let (done, wait) = mpsc::channel();
    thread::spawn(move || {
        // Nobody listens any more if this came too late.
        let _ = done.send(make());
    });
    wait.recv_timeout(LIMIT).unwrap_or_else(|e| {
        let what = match e {
            mpsc::RecvTimeoutError::Timeout => format!("it has not come back after {} s", LIMIT.as_secs()),
            mpsc::RecvTimeoutError::Disconnected => "it ended its thread".into(),
        };
        Err(refused(ty, &what))
    })
}

fn refused(ty: &Type, what: &str) -> Error {
    Error::unsupported(ty.words(), format!("refused: {what}"))
}

/// Tries an encoder, a normalizer or a field of type `ty`.
pub(crate) fn map(ty: &Type, stage: &dyn Stage) -> Result<()> {
    try_map(stage)?.map_or(Ok(()), |complaint| Err(refused(ty, &complaint)))
}

/// The first complaint about a stage.
fn try_map(stage: &dyn Stage) -> Result<Option<String>> {
    let info = stage.info();
    let mut params = Guarded::zeroed(info.params);
    if info.params <= MANY {
        stage.init(1, params.inner());
        stage.fault()?;
        if let Some(c) = params.broken("parameters").or_else(|| params.unsound("initial parameters")) {
            return Ok(Some(c));
        }
    }
    if let Some(c) = try_kernel(stage, stage.kernel(), &mut params)? {
        return Ok(Some(c));
    }
    let Some(Halves { f16, bf16 }) = stage.halves() else { return Ok(None) };
    let complaint = match try_halves(stage, f16, &mut params)? {
        None => try_halves(stage, bf16, &mut params)?,
        some => some,
    };
    Ok(complaint.map(|c| format!("with parameters in halves, {c}")))
}

/// The first complaint about a kernel that reads halves.
fn try_halves<H: Half>(stage: &dyn Stage, kernel: &dyn Kernel<f32, H>, params: &mut Guarded) -> Result<Option<String>> {
    let mut halves = Pages::<H>::zeros(params.inner().len());
    if halves.len() <= MANY {
        round(params.inner(), &mut halves);
    }
    try_kernel(stage, &Reader { kernel, params: &halves }, params)
}

/// The first complaint about a kernel of a stage.
fn try_kernel(stage: &dyn Stage, kernel: &dyn Kernel<f32>, params: &mut Guarded) -> Result<Option<String>> {
    let info = stage.info();
    let range: Range<usize> = match info.grads {
        GradKind::Scatter => stage.partition().into_iter().min_by_key(Range::len).unwrap_or(0..info.params),
        _ => 0..info.params,
    };
    for rows in [1, 3, TILE_ROWS] {
        let mut x = Guarded::new(info.input * rows);
        for (i, x) in x.inner().iter_mut().enumerate() {
            *x = unit(mix(7, i as u64));
        }
        let [mut y, mut tape, mut dx] = [info.output, info.tape, info.input].map(|c| Guarded::new(c * rows));
        let mut grads = Guarded::zeroed(range.len());
        kernel.forward(
            params.inner(),
            Tile::new(x.inner(), rows),
            TileMut::new(y.inner(), rows),
            TileMut::new(tape.inner(), rows),
        );
        stage.fault()?;
        let mut complaint = y.broken("output").or_else(|| tape.broken("tape"));
        complaint = complaint.or_else(|| y.unsound("output")).or_else(|| {
            (info.identity && y.inner() != x.inner()).then(|| "its output is not its input, as it says".into())
        });
        if complaint.is_some() {
            return Ok(complaint);
        }
        if kernel.passes() > 1 {
            let [mut again, mut left] = [info.output, info.tape].map(|c| Guarded::new(c * rows));
            for pass in 0..kernel.passes() {
                let (y, tape) = (TileMut::new(again.inner(), rows), TileMut::new(left.inner(), rows));
                kernel.forward_pass(pass, params.inner(), Tile::new(x.inner(), rows), y, tape);
            }
            stage.fault()?;
            let complaint = again.broken("output in passes").or_else(|| left.broken("tape in passes"));
            let same = again.inner() == y.inner() && left.inner() == tape.inner();
            let complaint = complaint.or_else(|| (!same).then(|| "its passes together are not its forward".into()));
            if complaint.is_some() {
                return Ok(complaint);
            }
        }
        let dy = vec![1.0; info.output * rows];
        kernel.backward(
            params.inner(),
            Tile::new(x.inner(), rows),
            TileMut::new(tape.inner(), rows),
            Tile::new(&dy, rows),
            Grads { values: grads.inner(), range: range.clone() },
            Some(TileMut::new(dx.inner(), rows)),
        );
        stage.fault()?;
        let complaint = grads.broken("gradients").or_else(|| dx.broken("input gradient"));
        let complaint = complaint.or_else(|| tape.broken("tape")).or_else(|| x.broken("input"));
        let complaint = complaint.or_else(|| params.broken("parameters"));
        let complaint = complaint.or_else(|| grads.unsound("gradients")).or_else(|| dx.unsound("input gradient"));
        if complaint.is_some() {
            return Ok(complaint);
        }
    }
    Ok(None)
}

/// Tries a projector of type `ty`: `cast` samples a ray, with that many untouchable numbers behind the samples, and gives
/// the line integral of ones.
pub(crate) fn projector(ty: &Type, cast: impl Fn(&UnitRay, Option<u64>, usize) -> Result<f64>) -> Result<()> {
    let ray = |origin, direction: [f32; 3], inside| UnitRay {
        origin,
        direction,
        inside,
        published: [0.5, 3.0],
        per_mm: 0.01,
    };
    let third = (1.0f32 / 3.0).sqrt();
    for ray in [
        ray([-1.0, 0.5, 0.5], [1.0, 0.0, 0.0], [1.0, 2.0]),
        ray([-third; 3], [third; 3], [1.0, 1.0 + 1.0 / third]),
        ray([0.5, 2.0, 0.25], [0.0, -1.0, 0.0], [1.0, 2.0]),
        ray([-1.0, 5.0, 0.5], [1.0, 0.0, 0.0], [0.0, 0.0]),
    ] {
        for seed in [None, Some(3)] {
            let line = cast(&ray, seed, GUARD)?;
            if !line.is_finite() {
                return Err(refused(ty, &format!("the line integral of ones is {line}")));
            }
        }
    }
    Ok(())
}

/// Numbers on either side of the few that a loss or a prior writes.
const EDGE: usize = 256;

/// Room for `n` numbers in double precision between guard zones.
fn room(n: usize) -> Vec<f64> {
    vec![f64::from_bits(UNTOUCHED.into()); n + 2 * EDGE]
}

/// What is wrong with the zones of `room`.
fn spilt(room: &[f64], what: &str) -> Option<String> {
    let mut zones = room[..EDGE].iter().chain(&room[room.len() - EDGE..]);
    let broken = zones.any(|v| v.to_bits() != u64::from(UNTOUCHED));
    broken.then(|| format!("it writes outside the {} numbers of its {what}", room.len() - 2 * EDGE))
}

/// Tries a loss of type `ty`: `at` compares pairs of a predicted and a measured value.
pub(crate) fn loss(ty: &Type, at: impl Fn(&[f64], &[f64], [&mut [f64]; 2]) -> Result<()>) -> Result<()> {
    let values: Vec<f64> = (0..16).map(|i| 0.25 * f64::from(i) - 0.5).collect();
    for shift in [0.0, 0.25, -1.0] {
        let predicted: Vec<f64> = values.iter().map(|v| v + shift).collect();
        let [mut loss, mut slope] = [room(values.len()), room(values.len())];
        let inside = EDGE..EDGE + values.len();
        at(&predicted, &values, [&mut loss[inside.clone()], &mut slope[inside.clone()]])?;
        let complaint = spilt(&loss, "losses").or_else(|| spilt(&slope, "slopes"));
        let complaint = complaint.or_else(|| {
            let all = inside.map(|i| (loss[i], slope[i]));
            let unwritten = |v: f64| v.to_bits() == u64::from(UNTOUCHED);
            let bad = all
                .enumerate()
                .find(|(_, (l, s))| !(l.is_finite() && *l >= 0.0 && s.is_finite()) || unwritten(*l) || unwritten(*s));
            let (i, (loss, slope)) = bad?;
            let [p, m] = [predicted[i], values[i]];
            Some(if unwritten(loss) || unwritten(slope) {
                format!("predicted {p}, measured {m}: a number is left unwritten")
            } else {
                format!("predicted {p}, measured {m}: loss {loss}, slope {slope}")
            })
        });
        if let Some(complaint) = complaint {
            return Err(refused(ty, &complaint));
        }
    }
    Ok(())
}

/// Tries a prior of type `ty` on a block of `points`: `block` adds to the gradient and gives the penalty.
pub(crate) fn prior(ty: &Type, points: usize, block: impl Fn(&[f64], &mut [f64]) -> Result<f64>) -> Result<()> {
    let values: Vec<f64> = (0..points).map(|i| f64::from(unit(mix(5, i as u64)))).collect();
    let mut gradient = room(points);
    gradient[EDGE..EDGE + points].fill(0.0);
    let penalty = block(&values, &mut gradient[EDGE..EDGE + points])?;
    let complaint = spilt(&gradient, "gradient").or_else(|| {
        let wild = gradient[EDGE..EDGE + points].iter().position(|g| !g.is_finite());
        let wild = wild.map(|i| format!("derivative {i} of {points} is {}", gradient[EDGE + i]));
        (!(penalty.is_finite() && penalty >= 0.0)).then(|| format!("the penalty of a block is {penalty}")).or(wild)
    });
    complaint.map_or(Ok(()), |c| Err(refused(ty, &c)))
}
