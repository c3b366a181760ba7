//! The checks of each kind, for a stage that its settings build.

use crate::losses::ready;
use crate::{
    Options, Report, Unmet, check_basis, check_data_term, check_encoder, check_field, check_initializer, check_loss,
    check_loss_wgsl, check_normalizer, check_prior, check_prior_wgsl, check_projector, check_projector_wgsl,
    check_regularizer, check_voxel_projector, check_wgsl,
};
use conefield_core::prelude::*;
use conefield_core::registry::{Kind, Origin, Settings, read, stage_types};
use conefield_core::runner::Runner;
use conefield_core::spec::check;
use conefield_core::voxel::VoxelProjectorSpec;
use serde_json::Value;

/// How [`check_type`] checks a stage.
pub struct With<'a> {
    /// Input channels of normalizers and fields. WGSL is checked at the largest number only: it takes long to compile.
    pub widths: &'a [usize],
    /// Changes the default options of stages that map rows.
    pub options: &'a dyn Fn(Options) -> Options,
    /// The device for WGSL, or the reason why there is none. It is asked for only if a stage has WGSL.
    pub device: &'a dyn Fn() -> std::result::Result<&'a dyn Runner, String>,
}

impl With<'_> {
    /// Adds the check of a stage's WGSL to its report.
    fn on_device(&self, mut report: Report, has_wgsl: bool, check: impl FnOnce(&dyn Runner) -> Report) -> Report {
        let skipped = |why: String| vec![("WGSL parity", Err(Unmet::Skipped(why)))];
        report.entries.extend(match has_wgsl.then(|| (self.device)()) {
            None => skipped("the stage offers none".into()),
            Some(Err(why)) => skipped(why),
            Some(Ok(device)) => check(device).entries,
        });
        report
    }

    fn rows(&self, report: Report, stage: &dyn Stage, options: &Options) -> Report {
        self.on_device(report, stage.wgsl().is_some(), |device| check_wgsl(stage, options, device))
    }

    fn loss(&self, loss: &dyn Loss) -> Report {
        self.on_device(check_loss(loss), loss.wgsl().is_some(), |device| check_loss_wgsl(loss, device))
    }

    /// The report of each width, with WGSL at the largest. The stage may refuse all but one: a field may accept only the
    /// channels of a point, a normalizer only whole levels.
    fn wide<S: ?Sized>(
        &self,
        build: impl Fn(usize) -> Result<Box<S>>,
        check: fn(&S, &Options) -> Report,
        stage: fn(&S) -> &dyn Stage,
    ) -> Result<Vec<(Option<usize>, Report)>> {
        let options = (self.options)(Options::features());
        let largest = self.widths.iter().max();
        let (mut found, mut refused) = (vec![], None);
        for width in self.widths {
            match build(*width) {
                Ok(built) => {
                    let report = check(&built, &options);
                    let last = Some(width) == largest;
                    let report = if last { self.rows(report, stage(&built), &options) } else { report };
                    found.push((Some(*width), report));
                }
                Err(e) => refused = Some(e),
            }
        }
        refused.filter(|_| found.is_empty()).map_or(Ok(found), Err)
    }
}

impl With<'static> {
    /// The defaults, without a device.
    pub const ON_THE_HOST: Self = Self {
        widths: &WIDTHS,
        options: &|options| options,
        device: &|| Err("no device is opened here; `conefield plugins check` opens one".into()),
    };
}

/// Numbers of input channels at which normalizers and fields are checked by default.
pub const WIDTHS: [usize; 4] = [1, 3, 8, 20];

/// Checks every stage type that the crate `package` registers, for the tests of a plugin: with the settings of its
/// registration, unless they are incomplete, and with the `examples` of its schema.
pub fn check_package(package: &str) -> Result<Vec<Report>> {
    let mut reports = vec![];
    for t in stage_types() {
        if matches!(t.origin, Origin::Linked { package: own, .. } if own == package) {
            for mut settings in tried(t.name, &t.schema(), t.example())? {
                settings["type"] = t.name.into();
                let found = check_type(t.kind, &settings, &With::ON_THE_HOST)?;
                reports.extend(found.into_iter().map(|(_, report)| report));
            }
        }
    }
    ensure(!reports.is_empty(), package, "stages", "none", "at least one registered stage type")?;
    Ok(reports)
}

/// The settings with which a type called `name` is tried: `own`, unless some that its `schema` requires are missing, and
/// the schema's `examples`, which must be tables.
pub fn tried(name: &str, schema: &Value, own: Value) -> Result<Vec<Value>> {
    let mut required = schema["required"].as_array().into_iter().flatten().filter_map(Value::as_str);
    let mut all = vec![];
    if required.all(|key| own.get(key).is_some()) {
        all.push(own);
    }
    all.extend(schema["examples"].as_array().into_iter().flatten().cloned());
    let other = all.iter().find(|settings| !settings.is_object());
    other.map_or(Ok(()), |found| Err(Error::invalid(name, "examples", found, "tables of settings")))?;
    Ok(all)
}

/// Builds a stage of `kind` from `settings`, which include its type and are checked as those in a spec are, and runs the
/// checks of the kind. Gives each report with the number of input channels, where that is a choice.
pub fn check_type(kind: Kind, settings: &Value, with: &With<'_>) -> Result<Vec<(Option<usize>, Report)>> {
    fn of<T: Settings + ?Sized + 'static>(settings: &Value) -> Result<Box<T>> {
        read(settings.clone()).map_err(|e| Error::invalid("stage", "type", e, "a registered type with its settings"))
    }
    check::settings(kind, settings, &format!("settings of {}", settings["type"].as_str().unwrap_or_default()))?;
    let one = |report| Ok(vec![(None, report)]);
    match kind {
        Kind::Encoder => {
            let (stage, options) = (of::<dyn EncoderSpec>(settings)?.build()?, (with.options)(Options::encoder()));
            one(with.rows(check_encoder(stage.as_ref(), &options), stage.as_ref(), &options))
        }
        Kind::Normalizer => {
            let spec = of::<dyn NormalizerSpec>(settings)?;
            with.wide::<dyn Normalizer>(|width| spec.build(width), check_normalizer, |stage| stage)
        }
        Kind::Field => {
            let spec = of::<dyn FieldSpec>(settings)?;
            with.wide::<dyn Field>(|width| spec.build(width), check_field, |stage| stage)
        }
        Kind::Projector => {
            let stage = of::<dyn ProjectorSpec>(settings)?.build()?;
            let report = check_projector(stage.as_ref());
            one(with.on_device(report, stage.wgsl().is_some(), |device| check_projector_wgsl(stage.as_ref(), device)))
        }
        Kind::Initializer => {
            let none = |path: &str| -> Result<Weights> { Err(Error::unsupported(path, "no weights are read here")) };
            one(check_initializer(of::<dyn InitializerSpec>(settings)?.build(&none)?.as_ref()))
        }
        Kind::Loss => {
            let loss = of::<dyn LossSpec>(settings)?.build()?;
            let all = [Some(with.loss(loss.as_ref())), ready(loss.as_ref()).map(|fitted| with.loss(fitted.as_ref()))];
            Ok(all.into_iter().flatten().map(|report| (None, report)).collect())
        }
        Kind::Prior => {
            let stage = of::<dyn PriorSpec>(settings)?.build()?;
            let report = check_prior(stage.as_ref());
            one(with.on_device(report, stage.wgsl().is_some(), |device| check_prior_wgsl(stage.as_ref(), device)))
        }
        Kind::Regularizer => one(check_regularizer(of::<dyn RegularizerSpec>(settings)?.build()?.as_ref())),
        Kind::DataTerm => one(check_data_term(of::<dyn DataTermSpec>(settings)?.build()?.as_ref())),
        Kind::Basis => one(check_basis(of::<dyn BasisSpec>(settings)?.build()?.as_ref())),
        Kind::VoxelProjector => one(check_voxel_projector(of::<dyn VoxelProjectorSpec>(settings)?.build()?.as_ref())),
        Kind::Method | Kind::Callback => {
            Err(Error::unsupported("conformance kit", format!("it has no checks of a {kind}")))
        }
    }
}
