//! `conefield report`: the page contains the data of the runs' files, and a browser shows it.

use crate::common::{Folder, SCAN as SMALL};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use conefield_evaluation::report::Pixels;
use conefield_io::{read_volume, write_volume};
use ndarray::Array3;
use serde_json::Value;
use std::fs;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::process::Command;

/// A scan, and a run with a reference.
const SCAN: &str = "simulate phantom:head:24 -o scan --views 9 --detector 20x28";
const RUN: &str = "reconstruct scan --spec sirt -o run --reference truth --hold-out 4 --steps 3";

/// Parts of `page.html`.
struct Page {
    html: String,
    data: Value,
}

impl Page {
    fn read(d: &Folder) -> Self {
        let html = d.text("page.html");
        let (_, rest) = html.split_once(" id=\"page\">").expect("the data of the page");
        let data = serde_json::from_str(rest.split_once("</script>").unwrap().0).unwrap();
        Self { html, data }
    }

    fn names(&self, what: &str) -> Vec<&str> {
        self.data[what].as_array().unwrap().iter().map(|v| v["name"].as_str().unwrap()).collect()
    }
}

#[test]
fn the_page_holds_what_the_files_have_and_fetches_nothing() {
    let d = Folder::after(&[SCAN, RUN]);
    let said = d.json("report run -o page.html --json");
    assert_eq!(said["bytes"], d.bytes("page.html").len());
    assert_eq!((&said["coarser"], said["runs"][0].as_str()), (&1.into(), Some("sirt")));
    let page = Page::read(&d);
    assert_eq!(page.names("volumes"), ["sirt", "reference"]);
    // It opens with the reference beside the result, both in the reference's grey window.
    assert_eq!(page.data["beside"], 1);
    assert_eq!(page.data["volumes"][0]["window"], page.data["volumes"][1]["window"]);
    let spacing: [f64; 3] = serde_json::from_value(page.data["volumes"][0]["spacing"].clone()).unwrap();
    let truth = read_volume(d.at("scan/truth.nii.gz")).unwrap().grid.spacing;
    assert!(spacing.iter().zip(truth).all(|(a, b)| (a - b).abs() < 1e-6));

    let shown = &page.data["runs"][0];
    assert_eq!(shown["record"], d.read("run/record.json"));
    assert_eq!(shown["spec"], d.text("run/spec.toml"));
    assert!(shown["plan"].as_str().unwrap().contains("sart"), "{}", shown["plan"]);
    assert_eq!(shown["curves"].as_array().unwrap().len(), d.text("run/metrics.jsonl").lines().count());

    // Projections: those of `project`, and the held-out view.
    let views = &page.data["scans"][0]["views"];
    let numbers: Vec<u64> = views.as_array().unwrap().iter().map(|v| v["view"].as_u64().unwrap()).collect();
    assert_eq!(numbers, [0, 1, 3, 4, 6, 7]);
    assert!((0..6).all(|i| views[i]["held_out"] == (numbers[i] == 4)), "{views}");
    let projected = d.json("project run/volume.nii.gz --like scan -o predicted --views 0,1,3,4,6,7 --json");
    for (i, image) in shown["views"]["images"].as_array().unwrap().iter().enumerate() {
        assert_eq!(image["rms"], projected["residual_rms_of_views"][i]);
        for kind in ["predicted", "residual"] {
            let png = STANDARD.decode(image[kind].as_str().unwrap().strip_prefix("data:image/png;base64,").unwrap());
            let picture = Pixels::read_png(std::io::Cursor::new(png.unwrap()), "a page".as_ref()).unwrap();
            assert_eq!((picture.width, picture.height), (28, 20));
        }
    }
    assert!(page.data["scans"][0]["geometry"].as_str().unwrap().starts_with("data:image/png;base64,"));

    // The page fetches nothing: the policy forbids it, and no element requests it.
    assert!(page.html.contains("content=\"default-src 'none'; script-src 'unsafe-inline'"));
    let (mut rest, mut scripts) = (&page.html[..], 0);
    loop {
        let (part, script) = rest.split_once("<script").unwrap_or((rest, ""));
        assert!(!part.contains("src=") && !part.contains("url(") && !part.contains("@import"), "{part}");
        assert!(part.split("href=\"").skip(1).all(|link| link.starts_with('#')), "{part}");
        let Some((tag, inside)) = script.split_once('>') else { break };
        assert!(!tag.contains("src"), "{tag}");
        rest = inside.split_once("</script>").unwrap().1;
        scripts += 1;
    }
    assert_eq!(scripts, 6);
}

#[test]
fn runs_stand_beside_each_other() {
    // Runs with the same name are distinguished by their folders.
    let d = Folder::after(&[SCAN, RUN, &RUN.replace("-o run", "-o again")]);
    d.done("report run again -o page.html");
    assert_eq!(Page::read(&d).names("runs"), ["run", "again"]);

    // A comparison adds all its runs; volumes that are too large are coarsened, including the reference.
    d.done("compare scan --specs fdk,cgls -o compared --steps 2 --reference truth");
    let said = d.done("report compared -o page.html --force --embed 40KiB --views 2");
    assert!(said.contains("means of 2 x 2 x 2 voxels") && said.contains("2 runs, 3 volumes, 1 view "), "{said}");
    let page = Page::read(&d);
    assert_eq!(page.names("volumes"), ["fdk", "cgls", "reference"]);
    assert_eq!(page.data["volumes"][2]["shape"], serde_json::json!([12, 12, 12]));
    // Without its scan a run still shows its volume; another scan is refused.
    fs::rename(d.at("scan"), d.at("moved")).unwrap();
    let said = d.done("report run -o page.html --force");
    assert!(said.contains("no longer at") && said.contains("the reference truth is not there"), "{said}");
    let page = Page::read(&d);
    assert_eq!((page.names("volumes"), page.names("scans").len()), (vec!["sirt"], 0));
    let said = d.done("report run -o page.html --force --scan moved");
    assert!(!said.contains("warning: ") || !said.contains("no longer"), "{said}");
    assert_eq!(Page::read(&d).names("volumes"), ["sirt", "reference"]);
    d.done("simulate phantom:head:24 -o other --views 5 --detector 20x28");
    d.refused_with(1, "report run -o page.html --force --scan other", &["another scan than the one of"]);
}

#[test]
fn the_page_of_a_study_has_one_reference_and_means_over_the_seeds() {
    let d = Folder::new();
    let study =
        "volumes = ['phantom:head:16']\nspecs = ['fdk', 'cgls']\nseeds = [1, 2]\nviews = [8]\n[protocol]\nsteps = 2\n";
    d.put("s.toml", study);
    d.done("study s.toml -o study");
    d.done("report study -o page.html");
    let page = Page::read(&d);
    // Each seed has a scan with a file of its own, but the truth is the same.
    assert_eq!((page.names("volumes").len(), page.names("volumes")[4]), (5, "reference"));
    assert_eq!(page.data["beside"], Value::Null);
    assert_eq!(page.names("spreads"), ["head-16-8views/fdk", "head-16-8views/cgls"]);
    assert_eq!(page.data["spreads"][0]["figures"], d.read("study/table.json")["summary"][0]["figures"]);
    assert!(page.data["spreads"][0]["figures"]["psnr"]["sd"].is_number());
}

#[test]
fn an_unfinished_run_shows_how_far_it_came() {
    let d = Folder::after(&[SCAN, RUN]);
    for name in ["record.json", "volume.nii.gz"] {
        fs::remove_file(d.at("run").join(name)).unwrap();
    }
    d.put("run/metrics.jsonl", d.text("run/metrics.jsonl") + "{\"step\": 4, \"sec");
    let said = d.done("report run -o page.html");
    assert!(said.contains("the run is interrupted"), "{said}");
    let page = Page::read(&d);
    let last = page.data["runs"][0]["curves"].as_array().unwrap().last().unwrap()["step"].as_u64();
    assert_eq!((last, page.names("volumes").len()), (Some(3), 0));
}

#[test]
fn bad_input_is_refused_before_anything_is_written() {
    let d = Folder::after(&[SCAN, RUN]);
    fs::create_dir(d.at("empty")).unwrap();
    // A volume of another shape is not accepted as a reference.
    let mut small = read_volume(d.at("scan/truth.nii.gz")).unwrap();
    small.data = Array3::zeros((8, 8, 8));
    small.grid.shape = [8; 3];
    write_volume(d.at("small.nii"), &small).unwrap();
    d.refuses(
        "page.html",
        &[
            ("report none -o page.html", "none"),
            ("report empty -o page.html", "or a study (table.json)"),
            ("report scan -o page.html", "or a study (table.json)"),
            ("report run run -o page.html", "each run once"),
            ("report run -o page.pdf", "an end of .html"),
            ("report run -o page.html --views 9", "below 9"),
            ("report run -o page.html --projector magic", "joseph, siddon, trilinear"),
            ("report run -o page.html --scan none", "none"),
            ("report run -o page.html --reference none.nii", "none.nii"),
            ("report run -o page.html --reference small.nii", "[24, 24, 24]"),
            ("report run -o page.html --memory 1MiB", "--memory allows 1.0 MiB"),
        ],
    );
    // Existing files stay; inputs stay even with --force.
    d.put("page.html", "mine");
    assert!(d.refused(1, "report run -o page.html").contains("--force"));
    assert_eq!(d.text("page.html"), "mine");
    d.put("run/page.html", "within");
    assert!(d.refused(1, "report run -o run/page.html --force").contains("which this command reads"));
    // An invalid record.
    d.put("run/record.json", "{\"version\": 1}");
    assert!(
        d.refused(1, "report run -o page.html --force").contains("record.json:1:13: version: found 1, expected a text")
    );
}

/// A headless browser.
fn browser() -> Option<PathBuf> {
    let paths = std::env::var_os("PATH")?;
    let names = ["chromium", "chromium-browser", "google-chrome", "chrome"];
    std::env::split_paths(&paths).flat_map(|folder| names.map(|n| folder.join(n))).find(|p| p.is_file())
}

/// The document after its scripts have run, opened at `address`.
fn shown(browser: &Path, profile: &Path, address: &str) -> String {
    let out = Command::new(browser)
        .args(["--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"])
        .arg(format!("--user-data-dir={}", profile.display()))
        .args(["--host-resolver-rules=MAP * ~NOTFOUND", "--virtual-time-budget=60000", "--dump-dom", address])
        .output()
        .unwrap();
    String::from_utf8(out.stdout).unwrap()
}

#[test]
fn a_browser_tells_the_value_at_a_voxel() {
    let Some(browser) = browser() else {
        eprintln!("SKIPPED: no browser (chromium or google-chrome) on PATH");
        return;
    };
    let d = Folder::after(&[SCAN, RUN]);
    d.done("report run -o page.html");
    let volumes = ["run/volume.nii.gz", "scan/truth.nii.gz"].map(|name| read_volume(d.at(name)).unwrap());
    let grid = conefield_scans::read_scan(d.at("scan")).unwrap().geometry.volume;
    for voxel in [[5, 14, 9], [12, 12, 20]] {
        let mm = grid.voxel(voxel).map(|x| x.to_string()).join(",");
        let address = format!("file://{}#show=0&minus=1&at={mm}", d.at("page.html").display());
        let dom = shown(&browser, &d.at("profile"), &address);
        assert!(dom.contains("data-ready=\"yes\""), "{}", dom.split("<script").next().unwrap());
        let place = voxel.map(|i| i.to_string()).join(", ");
        assert!(dom.contains(&format!("voxel {place}<")), "{place}");
        for (i, volume) in volumes.iter().enumerate() {
            let (_, rest) = dom.split_once(&format!("data-volume=\"{i}\" data-value=\"")).unwrap();
            let found: f64 = rest.split_once('"').unwrap().0.parse().unwrap();
            let want = f64::from(volume.data[voxel]);
            assert!((found - want).abs() < 1e-4, "{voxel:?}: {found} {want}");
        }
    }
}

/// The answer to `question` of the server at `port`, or `None` where there is none yet.
fn asked(port: u16, question: &str) -> Option<String> {
    let mut stream = std::net::TcpStream::connect(("127.0.0.1", port)).ok()?;
    stream.write_all(format!("{question}\r\n\r\n").as_bytes()).ok()?;
    let mut all = String::new();
    stream.read_to_string(&mut all).ok()?;
    Some(all)
}

#[test]
fn a_run_that_is_watched_shows_its_page_to_this_machine_alone() {
    let d = Folder::after(&[SMALL]);
    // A port that was free a moment ago.
    let port = std::net::TcpListener::bind(("127.0.0.1", 0)).unwrap().local_addr().unwrap().port();
    let mut child =
        d.started(&format!("reconstruct scan --spec fast -o run --steps 1000000 --live 0.1s --watch={port}"));
    let page = || asked(port, &format!("GET / HTTP/1.1\r\nHost: localhost:{port}"));
    let whole = |html: &String| html.contains("data:image/png;base64,iVBOR") && html.contains("\"loss\":");
    let start = std::time::Instant::now();
    let mut found = None;
    while found.is_none() && start.elapsed().as_secs() < 60 {
        found = page().filter(whole);
        std::thread::sleep(std::time::Duration::from_millis(200));
    }
    let ask = |line: &str, host: &str| asked(port, &format!("{line}\r\nHOST: {host}")).unwrap_or_default();
    let own = format!("127.0.0.1:{port}");
    let others = [
        ask("GET / HTTP/1.1", "evil.example"),
        ask("GET /../x HTTP/1.1", &own),
        ask("POST / HTTP/1.1", &own),
        ask("GET / HTTP/1.1", "127.0.0.1:1"),
    ];
    child.kill().unwrap();
    child.wait().unwrap();
    let found = found.expect("the page with a curve and a picture");
    assert!(found.starts_with("HTTP/1.1 200 OK\r\n") && found.contains("\"renewed\":5"));
    // Only this page may ask its server, and no other.
    assert!(found.contains("connect-src data: blob: 'self'\""));
    assert!(!found.contains("interrupted") && found.ends_with("</html>\n"));
    for (answer, status) in others.iter().zip(["403", "404", "405", "403"]) {
        assert!(answer.starts_with(&format!("HTTP/1.1 {status} ")) && answer.len() < 500, "{answer}");
    }
}
