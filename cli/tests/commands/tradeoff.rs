//! `tradeoff`: halving, a front, specs that run, and `--resume` without repetition.

use crate::common::{Folder, number};
use conefield_evaluation::report::Pixels;
use serde_json::Value;

/// Three voxel bases and one field, small enough for budgets of seconds.
const LEVERS: &str = r#"
[[base]]
spec = "fdk"
[base.levers]
cutoff = [0.5]
[[base]]
spec = "os-sart"
[base.levers]
subsets = [2, 4]
[[base]]
spec = "tiny.toml"
"#;
const TINY: &str = "extends = \"fast\"\nname = \"tiny\"\n[encoder]\nlevels = 3\nlog2_table_size = 10\n[projector]\nsamples = 24\n[training]\nrays = 64\n[[priors]]\ntype = \"total-variation\"\nweight = 0.02\nblocks = 4\n";

/// A folder with a small scan and levers.
fn made() -> Folder {
    let d = Folder::after(&["simulate phantom:head:16 -o scan --views 12 --detector 16x16"]);
    d.put("levers.toml", LEVERS);
    d.put("tiny.toml", TINY);
    d
}

/// A search with held-out views.
fn line(budgets: &str, more: &str) -> String {
    let fixed = "--levers levers.toml --hold-out every:4 --candidates 5";
    format!("tradeoff scan -o out {fixed} --budgets {budgets} {more}")
}

fn names(list: &Value) -> Vec<&str> {
    list.as_array().unwrap().iter().map(|n| n.as_str().unwrap()).collect()
}

/// The trials of a search that is interrupted after two of them.
#[cfg(unix)]
fn interrupted(d: &Folder, first: &str) -> Vec<Value> {
    let state = "out/tradeoff.json";
    let trials = || if d.has(state) { d.read(state)["trials"].as_array().unwrap().clone() } else { vec![] };
    let said = d.interrupted(first, "INT", &|| trials().len() >= 2);
    assert!(said.contains("interrupted during") && said.contains("--resume"), "{said}");
    let before = trials();
    assert!((2..8).contains(&before.len()) && !d.has("out/front.png"));
    before
}

#[cfg(not(unix))]
fn interrupted(_: &Folder, _: &str) -> Vec<Value> {
    vec![]
}

/// One search, interrupted and resumed: finished trials keep their measured times, and the result is that of a whole one.
#[test]
fn halving_front_and_specs_agree() {
    let d = made();
    let first = line("2s,3s", "--reference truth");
    let before = interrupted(&d, &first);
    if !before.is_empty() {
        for (more, want) in
            [("--resume --seed 1", "--resume: "), ("--resume --peak 2", "--resume: peak"), ("", "an earlier search")]
        {
            d.refused_with(1, &format!("{first} {more}"), &[want]);
        }
    }
    let resumed = format!("{first} --resume --json");
    let found = d.json(&resumed);
    assert_eq!(found["trials"].as_array().unwrap()[..before.len()], before[..]);
    // The search is complete: nothing runs again, and the front is the same.
    assert_eq!(d.json(&resumed), found);
    assert!(d.has("out/front.png"));
    let said = d.refused(1, &format!("{} --force", first.replace("-o out", "-o scan")));
    assert!(said.contains("in it, which this command reads") && d.has("scan/scan.toml"), "{said}");
    assert_eq!(found, d.read("out/tradeoff.json"));
    let candidates: Vec<_> = found["search"]["candidates"].as_array().unwrap().iter().map(|c| &c["name"]).collect();
    assert_eq!(candidates, ["fdk", "os-sart", "tiny", "fdk-1", "os-sart-1"]);

    // Two of four voxel methods and the one field advance, and so do candidates that had too little time.
    let trials = found["trials"].as_array().unwrap();
    let rungs = found["rungs"].as_array().unwrap();
    let at = |budget: f64| trials.iter().filter(move |t| t["budget_s"] == budget);
    let short = at(2.0).filter(|t| t["status"] == "too-short").count();
    assert!(trials.iter().all(|t| t["status"] != "failed"), "{trials:?}");
    assert_eq!((names(&rungs[0]["tried"]).len(), at(2.0).count()), (5, 5));
    if short == 0 {
        assert_eq!((names(&rungs[0]["kept"]).len(), at(3.0).count(), trials.len()), (3, 3, 8));
        assert!(names(&rungs[0]["kept"]).contains(&"tiny"));
    }
    assert_eq!(rungs[1]["tried"], rungs[0]["kept"]);
    assert!(names(&rungs[1]["kept"]).is_empty());

    let points = found["points"].as_array().unwrap();
    assert!(names(&found["front"]).iter().all(|name| points.iter().any(|p| p["name"] == *name)));
    // One rank correlation per budget, over trials with both figures.
    let ranking = found["ranking"].as_array().unwrap();
    assert_eq!(ranking.len(), 2);
    for r in ranking {
        let both = at(number(&r["budget_s"])).filter(|t| t["held_out"].is_f64() && t["scores"].is_object());
        assert_eq!(r["trials"], both.count());
    }
    let picture = Pixels::open(d.at("out/front.png")).unwrap();
    assert_eq!((picture.width, picture.height), (2000, 750));
    let table = d.text("out/tradeoff.md");
    assert!(table.starts_with("| front | budget | PSNR dB |") && table.contains("rank correlation"), "{table}");
    assert!(
        found["search"]["device"].as_str().is_some_and(|cpu| table.contains(&format!(", {cpu}, conefield "))),
        "{table}"
    );

    // Every spec can be read back, and one runs for as many steps as its trial.
    let specs = d.names("out/front");
    for spec in &specs {
        let explained = d.json(&format!("explain out/front/{spec} --json"));
        assert_eq!(format!("{}.toml", explained["spec"].as_str().unwrap()), *spec);
    }
    assert!(specs.len() >= names(&found["front"]).len(), "{specs:?}");
    let best = found["best"].as_array().unwrap().iter().find(|b| b["kind"] == "field").unwrap();
    let best = best["point"].as_str().unwrap();
    let point = points.iter().find(|p| p["name"] == best).unwrap();
    let again = d.json(&format!("reconstruct scan --spec out/front/{best}.toml -o again --json"));
    assert_eq!(again["steps"].as_f64(), point["steps"].as_f64());

    // A method is chosen from the front.
    let picked = d.json("reconstruct scan --budget 4s --front out/front.toml -o picked --json");
    let chosen = picked["plan"]["point"].as_str().unwrap();
    assert!(points.iter().any(|p| p["name"] == chosen), "{chosen}");
    assert!(d.has(format!("out/front/{chosen}.toml")));
}

#[test]
fn without_a_reference_views_rank() {
    let d = made();
    let found = d.json(&line("2s", "--json"));
    assert!(found["ranking"].as_array().unwrap().is_empty());
    let points = found["points"].as_array().unwrap();
    assert!(points.iter().all(|p| p["psnr"].is_null() && number(&p["held_out"]) > 0.0));
    let least = points.iter().min_by(|a, b| number(&a["held_out"]).total_cmp(&number(&b["held_out"])));
    assert!(names(&found["front"]).contains(&least.unwrap()["name"].as_str().unwrap()));
    assert!(d.text("out/tradeoff.md").starts_with("| front | budget | held-out error |"));
}

#[test]
fn bad_input_makes_no_folder() {
    let d = made();
    let search = line("2s,3s", "").replace("--hold-out every:4", "");
    for (more, want) in [
        ("--reference nothing.nii", "nothing.nii"),
        ("--reference a.nii --reference b.nii", "1, one per scan"),
        ("--hold-out 99", "below 12"),
        ("--hold-out none", "views to rank by"),
    ] {
        d.refuses("out", &[(&format!("{search} {more}"), want)]);
    }
    let shown = d.done("tradeoff --show-levers");
    assert!(shown.contains("[[base]]\nspec = \"fast\""), "{shown}");
    d.done("tradeoff --show-levers s");
}
