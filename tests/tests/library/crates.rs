//! The crates stand in rows: each depends only on rows below it. `CONEFIELD_BLESS=1` draws the picture of
//! `docs/maintainers.md` anew.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// What each crate or module depends on, by short name.
pub type Needs = BTreeMap<String, BTreeSet<String>>;

/// Crates that only developers build.
const OWN: [&str; 4] = ["tests", "benches", "examples", "one-dependency"];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn manifest(path: &Path) -> toml::Table {
    std::fs::read_to_string(path).unwrap().parse().unwrap()
}

/// A user's crates alone, without tests and examples.
fn needs() -> Needs {
    let workspace = manifest(&root().join("Cargo.toml"));
    let members = workspace["workspace"]["members"].as_array().unwrap();
    let mut all = Needs::new();
    for member in members {
        let package = manifest(&root().join(member.as_str().unwrap()).join("Cargo.toml"));
        let short = |name: &str| name.strip_prefix("conefield-").unwrap_or(name).to_owned();
        let name = short(package["package"]["name"].as_str().unwrap());
        if OWN.contains(&&*name) {
            continue;
        }
        let used = package.get("dependencies").and_then(|d| d.as_table()).into_iter().flat_map(|d| d.keys());
        all.insert(name, used.filter(|u| u.starts_with("conefield")).map(|u| short(u)).collect());
    }
    all
}

/// The row of each crate or module: one above the highest of those it depends on.
///
/// # Errors
/// Those that depend on each other in a circle, and what depends on them.
pub fn rows(needs: &Needs) -> Result<BTreeMap<&str, usize>, Vec<&str>> {
    let mut rows = BTreeMap::new();
    while rows.len() < needs.len() {
        let before = rows.len();
        for (name, used) in needs {
            let below: Option<Vec<usize>> = used.iter().map(|u| rows.get(&**u).copied()).collect();
            if let Some(below) = below {
                rows.insert(&**name, below.into_iter().max().map_or(0, |row| row + 1));
            }
        }
        if rows.len() == before {
            return Err(needs.keys().map(|n| &**n).filter(|n| !rows.contains_key(n)).collect());
        }
    }
    Ok(rows)
}

/// Whether `from` reaches `to` by way of another crate: such an arrow is not drawn.
fn by_way(needs: &Needs, from: &str, to: &str) -> bool {
    let reaches = |a: &String| needs[a].contains(to) || by_way(needs, a, to);
    needs[from].iter().any(|next| next != to && reaches(next))
}

/// The picture: users of a crate stand above it.
fn picture(needs: &Needs) -> String {
    let rows = rows(needs).unwrap();
    let top = rows.values().max().unwrap();
    let [step_x, step_y, wide, high] = [140, 64, 120, 26];
    let mut place = BTreeMap::new();
    let mut most = 0;
    for row in 0..=*top {
        let names: Vec<&str> = rows.iter().filter(|(_, r)| **r == row).map(|(n, _)| *n).collect();
        most = most.max(names.len());
        for (i, name) in names.iter().enumerate() {
            place.insert(*name, (i, names.len(), top - row));
        }
    }
    let width = step_x * most;
    let middle = |name: &str| {
        let (i, n, row) = place[name];
        ((2 * i + 1) * width / (2 * n), step_y * row + 32)
    };
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {}\" font-family=\"sans-serif\" font-size=\"13\">\n\
         <style>rect {{ fill: #eef3fa; stroke: #4a6fa5 }} path {{ stroke: #7a8699; fill: none }} text {{ text-anchor: \
         middle; fill: #16202e }}</style>\n<rect x=\"0\" y=\"0\" width=\"{width}\" height=\"{}\" \
         style=\"fill: #ffffff; stroke: none\"/>\n",
        step_y * (top + 1),
        step_y * (top + 1)
    );
    for (name, used) in needs {
        for other in used.iter().filter(|u| !by_way(needs, name, u)) {
            let ((x0, y0), (x1, y1)) = (middle(name), middle(other));
            let (y0, y1) = (y0 + high / 2, y1 - high / 2);
            writeln!(svg, "<path d=\"M{x0} {y0} C{x0} {} {x1} {} {x1} {y1}\"/>", y0 + 24, y1 - 24).unwrap();
        }
    }
    for name in needs.keys() {
        let (x, y) = middle(name);
        writeln!(
            svg,
            "<rect x=\"{}\" y=\"{}\" width=\"{wide}\" height=\"{high}\" rx=\"4\"/><text x=\"{x}\" y=\"{}\">{name}</text>",
            x - wide / 2,
            y - high / 2,
            y + 4
        )
        .unwrap();
    }
    svg + "</svg>\n"
}

#[test]
fn no_crate_needs_what_needs_it() {
    let needs = needs();
    let row = rows(&needs).unwrap();
    // The order of the tree in docs/maintainers.md.
    let order =
        ["core", "projectors", "solvers", "scans", "evaluation", "conefield", "cli", "python"].map(|name| row[name]);
    assert!(order.is_sorted(), "{row:?}");
    assert!(row["core"] == 0 && needs["io"].len() == 1, "file formats need only core: {:?}", needs["io"]);
    assert!(needs.len() <= 18, "sixteen library crates, the command and the Python package: {:?}", needs.keys());
    conefield_tests::blessed::check(&root().join("docs/images/crates.svg"), &picture(&needs));
    // A circle is found.
    let mut wrong = needs.clone();
    wrong.get_mut("core").unwrap().insert("io".into());
    assert!(rows(&wrong).unwrap_err().contains(&"core"));
}
