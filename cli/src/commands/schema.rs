//! `conefield schema`

use crate::out;
use clap::Args;
use conefield::specs;
use conefield_core::registry::{Kind, Origin, stage_types};
use conefield_core::{Result, spec::schema};

/// Print the JSON Schema of spec files, for editors.
#[derive(Args)]
pub struct SchemaArgs {
    /// Print Markdown tables of the shipped specs and all types instead.
    #[arg(long)]
    tables: bool,
    /// Print the JSON Schema of study files instead.
    #[arg(long, conflicts_with = "tables")]
    study: bool,
}

impl SchemaArgs {
    pub fn run(self) -> Result<()> {
        match (self.tables, self.study) {
            (true, _) => out::say(&tables()?),
            (_, true) => out::json(&conefield::study::definition::schema()),
            _ => out::json(&schema::spec()),
        }
    }
}

/// The shipped specs, then every built-in type.
fn tables() -> Result<String> {
    let mut lines = vec!["| spec | what |".to_owned(), "| --- | --- |".into()];
    for s in specs::SHIPPED {
        lines.push(format!("| `{}` | {} |", s.name, specs::read(s.name, &[])?.spec.description));
    }
    lines.extend([String::new(), "| kind | type | what |".into(), "| --- | --- | --- |".into()]);
    for &kind in Kind::ALL {
        let of_kind = stage_types().into_iter().filter(|t| t.kind == kind);
        for t in of_kind.filter(|t| matches!(t.origin, Origin::Linked { .. })) {
            lines.push(format!("| {kind} | `{}` | {} |", t.name, t.doc));
        }
    }
    Ok(lines.join("\n"))
}
