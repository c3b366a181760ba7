//! Initializers.

use super::*;
use crate::spec::Loaded;
use conefield_core::arena::Block;
use conefield_core::settings::KnownVolume;

/// An initializer from a library.
pub struct InitializerStage {
    own: Foreign<ConefieldInitializer>,
    volume: Option<KnownVolume>,
}

settings! {
    initializer InitializerSpec(self, weights: &dyn Fn(&str) -> Result<Weights>) -> dyn Initializer {
        build(self, weights).map(Box::new)
    }
}

/// Builds an initializer; `weights` reads a file named in its settings.
fn build(loaded: &Loaded, weights: &dyn Fn(&str) -> Result<Weights>) -> Result<InitializerStage> {
    let (own, path) = *loaded.build(0, |handle| {
        let own = Foreign::<ConefieldInitializer>::new(handle)?;
        let path = named(&own.handle, "weights", |path| {
            // SAFETY: the stage is alive, `path` is writable.
            own.functions.weights.map(|f| unsafe { f(own.handle.stage, path) })
        })?;
        Ok((own, path))
    })?;
    let read = path.map(|p| weights(&p)).transpose()?;
    timed(&loaded.ty, move || {
        let own = match read {
            Some(weights) => with_weights(&own, &weights)?,
            None => own,
        };
        let mut steps = 0;
        let path = named(&own.handle, "volume", |path| {
            // SAFETY: the stage is alive, `path` and `steps` are writable.
            own.functions.volume.map(|f| unsafe { f(own.handle.stage, path, &mut steps) })
        })?;
        Ok(InitializerStage { own, volume: path.map(|path| KnownVolume { path, steps }) })
    })
}

/// A name from the stage, if it has the function and a name.
fn named(
    handle: &Handle,
    call: &str,
    ask: impl FnOnce(&mut ConefieldStr) -> Option<ConefieldStatus>,
) -> Result<Option<String>> {
    let mut path = ConefieldStr::of("");
    match ask(&mut path) {
        None | Some(CONEFIELD_UNSUPPORTED) => Ok(None),
        // SAFETY: the plugin guarantees that this many bytes are valid while the stage lives.
        Some(CONEFIELD_OK) => unsafe { text(path, &handle.ty.words(), call) }.map(Some),
        Some(status) => Err(handle.ty.failed(call, status, "")),
    }
}

/// The stage with these weights.
fn with_weights(own: &Foreign<ConefieldInitializer>, weights: &Weights) -> Result<Foreign<ConefieldInitializer>> {
    let tensor = |(name, (shape, values)): (&String, &(Vec<usize>, Vec<f32>))| ConefieldTensor {
        name: ConefieldStr::of(name),
        shape: shape.as_ptr(),
        dimensions: shape.len(),
        values: values.as_ptr(),
        length: values.len(),
    };
    let tensors: Vec<ConefieldTensor> = weights.tensors.iter().map(tensor).collect();
    own.derived("with_weights", make!(own, with_weights(tensors.as_ptr(), tensors.len()))?)
}

/// Blocks in the format of the ABI.
fn blocks(layout: &Layout) -> Vec<ConefieldBlock> {
    let block = |b: &Block| ConefieldBlock {
        name: ConefieldStr::of(&b.name),
        shape: b.shape.as_ptr(),
        dimensions: b.shape.len(),
        start: b.range.start,
        length: b.range.len(),
    };
    layout.blocks.iter().map(block).collect()
}

/// Guard numbers behind the parameters, which must not be written.
const GUARD: usize = 1 << 12;

impl Initializer for InitializerStage {
    fn check(&self, layout: &Layout) -> Result<()> {
        let blocks = blocks(layout);
        match self.own.functions.check {
            Some(_) => call!(self.own, check(blocks.as_ptr(), blocks.len())),
            None => Ok(()),
        }
    }

    fn apply(&self, layout: &Layout, arena: &mut Arena) -> Result<InitReport> {
        let blocks = blocks(layout);
        // A copy, so that errors do no harm.
        let n = arena.params.len();
        let mut params = arena.params.to_vec();
        params.resize(n + GUARD, f32::MARK);
        let mut filled = vec![0u8; blocks.len()];
        call!(self.own, apply(blocks.as_ptr(), blocks.len(), params.as_mut_ptr(), n, filled.as_mut_ptr()))?;
        let within = params[n..].iter().all(|v| v.is_mark());
        self.own.require(within, "apply", || "it writes past the parameters".into())?;
        let mut report = InitReport::default();
        for (b, &filled) in layout.blocks.iter().zip(&filled) {
            if filled == 0 {
                report.fresh.push((b.name.clone(), "not filled".into()));
                continue;
            }
            let from = &params[b.range.clone()];
            if let Some(v) = from.iter().find(|v| !v.is_finite()) {
                return Err(self.own.wrong("apply", &format!("{} holds {v}", b.name)));
            }
            arena.params[b.range.clone()].copy_from_slice(from);
            report.loaded.push(b.name.clone());
        }
        Ok(report)
    }

    fn volume(&self) -> Option<KnownVolume> {
        self.volume.clone()
    }

    said! { own: describe }
}
