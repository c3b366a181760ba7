//! `conefield report`: the page contains the data of the runs' files, and a browser shows it.

use crate::common::{done, json, refused, text};
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
use tempfile::{TempDir, tempdir};

/// A scan, and a run with a reference.
fn run(spec: &str, more: &[&str]) -> (TempDir, String, String) {
    let dir = tempdir().unwrap();
    let [scan, run] = ["scan", "run"].map(|name| text(&dir.path().join(name)));
    done(&["simulate", "phantom:head:24", "-o", &scan, "--views", "9", "--detector", "20x28"]);
    reconstruct(&scan, spec, &run, more);
    (dir, scan, run)
}

fn reconstruct(scan: &str, spec: &str, run: &str, more: &[&str]) {
    let all = ["reconstruct", scan, "--spec", spec, "-o", run, "--reference", "truth", "--hold-out", "4"];
    done(&[&all[..], more].concat());
}

/// Parts of the page in the file `path`.
struct Page {
    html: String,
    data: Value,
}

impl Page {
    fn read(path: &Path) -> Self {
        let html = fs::read_to_string(path).unwrap();
        let data = serde_json::from_str(Self::element(&html, "page")).unwrap();
        Self { html, data }
    }

    fn element<'a>(html: &'a str, id: &str) -> &'a str {
        let (_, rest) = html.split_once(&format!(" id=\"{id}\">")).unwrap_or_else(|| panic!("no {id}"));
        rest.split_once("</script>").unwrap().0
    }

    /// The values of a volume, [x, y, z], and their quantization step.
    fn volume(&self, index: usize) -> (Array3<f64>, f64) {
        let volume = &self.data["volumes"][index];
        let number = |key: &str| volume[key].as_f64().unwrap();
        let packed = STANDARD.decode(Self::element(&self.html, &format!("volume-{index}"))).unwrap();
        let mut raw = vec![];
        flate2::read::GzDecoder::new(&packed[..]).read_to_end(&mut raw).unwrap();
        let shape: [usize; 3] = serde_json::from_value(volume["shape"].clone()).unwrap();
        let n = shape.iter().product::<usize>();
        assert_eq!(raw.len(), 2 * n);
        let value = |i: usize| f64::from(i16::from_be_bytes([raw[i], raw[n + i]])) * number("slope") + number("offset");
        let at = |(x, y, z)| value(x + shape[0] * (y + shape[1] * z));
        (Array3::from_shape_fn(shape, at), number("slope"))
    }

    fn names(&self, what: &str) -> Vec<&str> {
        self.data[what].as_array().unwrap().iter().map(|v| v["name"].as_str().unwrap()).collect()
    }
}

/// Checks that the volume in the page is the one in the file.
fn holds(page: &Page, index: usize, file: &str) {
    let (found, step) = page.volume(index);
    let want = read_volume(file).unwrap().data;
    assert_eq!(found.shape(), want.shape());
    assert!(want.iter().any(|x| *x > 0.0));
    for (at, want) in want.indexed_iter() {
        assert!((found[at] - f64::from(*want)).abs() <= 0.51 * step, "{at:?}: {} {want}", found[at]);
    }
}

#[test]
fn the_page_holds_what_the_files_have_and_fetches_nothing() {
    let (dir, scan, run) = run("sirt", &["--steps", "3"]);
    let out = dir.path().join("page.html");
    let said = json(&["report", &run, "-o", &text(&out), "--json"]);
    assert_eq!(said["bytes"], fs::metadata(&out).unwrap().len());
    assert_eq!((&said["coarser"], said["runs"][0].as_str()), (&1.into(), Some("sirt")));
    let page = Page::read(&out);
    assert_eq!(page.names("volumes"), ["sirt", "reference"]);
    // It opens with the reference beside the result, both in the reference's grey window.
    assert_eq!(page.data["beside"], 1);
    assert_eq!(page.data["volumes"][0]["window"], page.data["volumes"][1]["window"]);
    holds(&page, 0, &format!("{run}/volume.nii.gz"));
    holds(&page, 1, &format!("{scan}/truth.nii.gz"));
    let spacing: Vec<f64> = serde_json::from_value(page.data["volumes"][0]["spacing"].clone()).unwrap();
    assert!(
        spacing
            .iter()
            .zip(read_volume(format!("{scan}/truth.nii.gz")).unwrap().grid.spacing)
            .all(|(a, b)| (a - b).abs() < 1e-6)
    );

    let shown = &page.data["runs"][0];
    let record: Value = serde_json::from_str(&fs::read_to_string(format!("{run}/record.json")).unwrap()).unwrap();
    assert_eq!(shown["record"], record);
    assert_eq!(shown["spec"], fs::read_to_string(format!("{run}/spec.toml")).unwrap());
    assert!(shown["plan"].as_str().unwrap().contains("sart"), "{}", shown["plan"]);
    let lines = fs::read_to_string(format!("{run}/metrics.jsonl")).unwrap();
    assert_eq!(shown["curves"].as_array().unwrap().len(), lines.lines().count());

    // Projections: those of `project`, and the held-out view.
    let views = &page.data["scans"][0]["views"];
    let numbers: Vec<u64> = views.as_array().unwrap().iter().map(|v| v["view"].as_u64().unwrap()).collect();
    assert_eq!(numbers, [0, 1, 3, 4, 6, 7]);
    assert!((0..6).all(|i| views[i]["held_out"] == (numbers[i] == 4)), "{views}");
    let projected = json(&[
        "project",
        &format!("{run}/volume.nii.gz"),
        "--like",
        &scan,
        "-o",
        &text(&dir.path().join("predicted")),
        "--views",
        "0,1,3,4,6,7",
        "--json",
    ]);
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
    let (dir, scan, first) = run("fdk", &[]);
    let at = |name: &str| text(&dir.path().join(name));
    let out = at("page.html");
    // Runs with the same name are distinguished by their folders.
    reconstruct(&scan, "fdk", &at("again"), &[]);
    done(&["report", &first, &at("again"), "-o", &out]);
    assert_eq!(Page::read(out.as_ref()).names("runs"), ["run", "again"]);

    // A comparison adds all its runs; volumes that are too large are coarsened, including the reference.
    done(&["compare", &scan, "--specs", "fdk,cgls", "-o", &at("compared"), "--steps", "2", "--reference", "truth"]);
    let said = done(&["report", &at("compared"), "-o", &out, "--force", "--embed", "40KiB", "--views", "2"]);
    assert!(said.contains("means of 2 x 2 x 2 voxels") && said.contains("2 runs, 3 volumes, 1 view "), "{said}");
    let page = Page::read(out.as_ref());
    assert_eq!(page.names("volumes"), ["fdk", "cgls", "reference"]);
    let (coarse, step) = page.volume(2);
    let truth = read_volume(format!("{scan}/truth.nii.gz")).unwrap().data;
    for ((x, y, z), mean) in coarse.indexed_iter() {
        let block = truth.slice(ndarray::s![2 * x..2 * x + 2, 2 * y..2 * y + 2, 2 * z..2 * z + 2]);
        assert!((block.mean().map(f64::from).unwrap() - mean).abs() <= step, "{x} {y} {z}");
    }
    // Without its scan a run still shows its volume; another scan is refused.
    fs::rename(&scan, at("moved")).unwrap();
    let said = done(&["report", &first, "-o", &out, "--force"]);
    assert!(said.contains("no longer at") && said.contains("the reference truth is not there"), "{said}");
    let page = Page::read(out.as_ref());
    assert_eq!((page.names("volumes"), page.names("scans").len()), (vec!["fdk"], 0));
    let said = done(&["report", &first, "-o", &out, "--force", "--scan", &at("moved")]);
    assert!(!said.contains("warning: ") || !said.contains("no longer"), "{said}");
    assert_eq!(Page::read(out.as_ref()).names("volumes"), ["fdk", "reference"]);
    done(&["simulate", "phantom:head:24", "-o", &at("other"), "--views", "5", "--detector", "20x28"]);
    let said = refused(1, &["report", &first, "-o", &out, "--force", "--scan", &at("other")]);
    assert!(said.contains("another scan than the one of"), "{said}");
}

#[test]
fn the_page_of_a_study_has_one_reference_and_means_over_the_seeds() {
    let dir = tempdir().unwrap();
    let at = |name: &str| text(&dir.path().join(name));
    let study =
        "volumes = ['phantom:head:16']\nspecs = ['fdk', 'cgls']\nseeds = [1, 2]\nviews = [8]\n[protocol]\nsteps = 2\n";
    fs::write(at("s.toml"), study).unwrap();
    done(&["study", &at("s.toml"), "-o", &at("study")]);
    done(&["report", &at("study"), "-o", &at("page.html")]);
    let page = Page::read(at("page.html").as_ref());
    // Each seed has a scan with a file of its own, but the truth is the same.
    assert_eq!((page.names("volumes").len(), page.names("volumes")[4]), (5, "reference"));
    assert_eq!(page.data["beside"], Value::Null);
    assert_eq!(page.names("spreads"), ["head-16-8views/fdk", "head-16-8views/cgls"]);
    let table: Value = serde_json::from_str(&fs::read_to_string(at("study/table.json")).unwrap()).unwrap();
    assert_eq!(page.data["spreads"][0]["figures"], table["summary"][0]["figures"]);
    assert!(page.data["spreads"][0]["figures"]["psnr"]["sd"].is_number());
}

#[test]
fn an_unfinished_run_shows_how_far_it_came() {
    let (dir, _, run) = run("sirt", &["--steps", "3"]);
    for name in ["record.json", "volume.nii.gz"] {
        fs::remove_file(format!("{run}/{name}")).unwrap();
    }
    let metrics = format!("{run}/metrics.jsonl");
    fs::write(&metrics, fs::read_to_string(&metrics).unwrap() + "{\"step\": 4, \"sec").unwrap();
    let out = dir.path().join("page.html");
    let said = done(&["report", &run, "-o", &text(&out)]);
    assert!(said.contains("the run is interrupted"), "{said}");
    let page = Page::read(&out);
    let last = page.data["runs"][0]["curves"].as_array().unwrap().last().unwrap()["step"].as_u64();
    assert_eq!((last, page.names("volumes").len()), (Some(3), 0));
}

#[test]
fn hostile_names_stay_text() {
    let dir = tempdir().unwrap();
    let at = |name: &str| text(&dir.path().join(name));
    let (name, folder) = ("</script><script>alert(1)</script>", "<img src=x onerror=alert(2)><!--");
    fs::write(at("spec.toml"), format!("extends = \"fdk\"\nname = \"{name}\"\ndescription = \"{name}\"\n")).unwrap();
    done(&["simulate", "phantom:head:16", "-o", &at(folder), "--views", "5", "--detector", "16x16"]);
    done(&["reconstruct", &at(folder), "--spec", &at("spec.toml"), "-o", &at("<run>")]);
    let out = dir.path().join("<page>.html");
    done(&["report", &at("<run>"), "-o", &text(&out)]);
    let page = Page::read(&out);
    assert_eq!(page.names("runs"), [name]);
    assert!(page.data["scans"][0]["line"].as_str().unwrap().contains(folder));
    for bad in ["alert(1)</", "<script>alert", "<img src=x"] {
        assert!(!page.html.contains(bad), "{bad}");
    }
}

#[test]
fn bad_input_is_refused_before_anything_is_written() {
    let (dir, scan, run) = run("fdk", &[]);
    let at = |name: &str| text(&dir.path().join(name));
    let out = at("page.html");
    fs::create_dir(at("empty")).unwrap();
    for (args, want) in [
        (&["report", &at("none"), "-o", &out][..], "none"),
        (&["report", &at("empty"), "-o", &out], "or a study (table.json)"),
        (&["report", &scan, "-o", &out], "or a study (table.json)"),
        (&["report", &run, &run, "-o", &out], "each run once"),
        (&["report", &run, "-o", &at("page.pdf")], "an end of .html"),
        (&["report", &run, "-o", &out, "--views", "9"], "below 9"),
        (&["report", &run, "-o", &out, "--projector", "magic"], "joseph, siddon, trilinear"),
        (&["report", &run, "-o", &out, "--scan", &at("none")], "none"),
        (&["report", &run, "-o", &out, "--reference", &at("none.nii")], "none.nii"),
        (&["--memory", "1MiB", "report", &run, "-o", &out], "--memory allows 1.0 MiB"),
    ] {
        let said = refused(1, args);
        assert!(said.contains(want) && !Path::new(&out).exists(), "{args:?}: {said}");
    }
    // A volume of another shape is not accepted as a reference.
    let mut small = read_volume(format!("{scan}/truth.nii.gz")).unwrap();
    small.data = Array3::zeros((8, 8, 8));
    small.grid.shape = [8; 3];
    write_volume(at("small.nii"), &small).unwrap();
    let said = refused(1, &["report", &run, "-o", &out, "--reference", &at("small.nii")]);
    assert!(said.contains("[24, 24, 24]"), "{said}");
    // Existing files stay; inputs stay even with --force.
    fs::write(&out, "mine").unwrap();
    assert!(refused(1, &["report", &run, "-o", &out]).contains("--force"));
    assert_eq!(fs::read_to_string(&out).unwrap(), "mine");
    let link = format!("{run}/page.html");
    fs::write(&link, "within").unwrap();
    assert!(refused(1, &["report", &run, "-o", &link, "--force"]).contains("which this command reads"));
    // An invalid record.
    fs::write(format!("{run}/record.json"), "{\"version\": 1}").unwrap();
    assert!(refused(1, &["report", &run, "-o", &out, "--force"]).contains("record.json: JSON"));
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
    let (dir, scan, run) = run("cgls", &["--steps", "3"]);
    let out = dir.path().join("page.html");
    done(&["report", &run, "-o", &text(&out)]);
    let result = read_volume(format!("{run}/volume.nii.gz")).unwrap();
    let truth = read_volume(format!("{scan}/truth.nii.gz")).unwrap();
    let grid = conefield_scans::read_scan(&scan).unwrap().geometry.volume;
    for voxel in [[5, 14, 9], [12, 12, 20]] {
        let mm = grid.voxel(voxel).map(|x| x.to_string()).join(",");
        let address = format!("file://{}#show=0&minus=1&at={mm}", out.display());
        let dom = shown(&browser, &dir.path().join("profile"), &address);
        assert!(dom.contains("data-ready=\"yes\""), "{}", dom.split("<script").next().unwrap());
        let place = voxel.map(|i| i.to_string()).join(", ");
        assert!(dom.contains(&format!("voxel {place}<")), "{place}");
        for (i, volume) in [&result, &truth].into_iter().enumerate() {
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
    let dir = tempdir().unwrap();
    let [scan, run] = ["scan", "run"].map(|name| text(&dir.path().join(name)));
    done(&["simulate", "phantom:head:16", "-o", &scan, "--views", "6", "--detector", "16x16"]);
    // A port that was free a moment ago.
    let port = std::net::TcpListener::bind(("127.0.0.1", 0)).unwrap().local_addr().unwrap().port();
    let watch = format!("--watch={port}");
    let mut child = Command::new(assert_cmd::cargo::cargo_bin("conefield"))
        .args([
            "-q", "reconstruct", &scan, "--spec", "fast", "-o", &run, "--steps", "1000000", "--live", "0.1s", &watch,
        ])
        .spawn()
        .unwrap();
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
