//! Weights and checkpoints.

use crate::case::{Case, changed, cut, cut_end, put, table, then};
use conefield_tests::hostile::seeds::{checkpoint, scan_toml, weights};
use std::path::Path;

const INFO: &str = "info w.safetensors";
const INIT: &str = "reconstruct scan --spec ni-naf --steps 1 --init w.safetensors -o run";
const RESUME: &str = "reconstruct scan --spec naf --steps 2 -o run --resume";

fn header(text: &'static str, data: usize) -> impl Fn(&Path) + Sync + Send {
    move |d| {
        put(d.join("w.safetensors"), [&(text.len() as u64).to_le_bytes(), text.as_bytes(), &vec![0; data]].concat())
    }
}

/// An interrupted run with this checkpoint.
fn run(make: impl Fn(&Path) + Sync + Send + 'static) -> impl Fn(&Path) + Sync + Send {
    then(scan_toml, move |d| {
        make(d);
        std::fs::create_dir(d.join("run")).unwrap();
        std::fs::rename(d.join("c.safetensors"), d.join("run/checkpoint.safetensors")).unwrap();
    })
}

pub fn cases() -> Vec<Case> {
    table! {
        "empty", |d| put(d.join("w.safetensors"), ""), INFO, ["header length", "0 bytes"];
        "cut within the length", changed(weights, "w.safetensors", cut(7)), INFO, ["header length", "7 bytes"];
        "cut within the header", changed(weights, "w.safetensors", cut(60)), INFO, ["header length"];
        "cut within the values", changed(weights, "w.safetensors", cut_end(1)), INFO, ["header"];
        "a header of 2^64 bytes", changed(weights, "w.safetensors", |b| b[..8].fill(255)),
            INFO, ["header length", "18446744073709551615"];
        "no JSON", header("{\"w\": nonsense}", 0), INFO, ["header", "safetensors"];
        "a header that is no UTF-8",
            |d| put(d.join("w.safetensors"), [&2u64.to_le_bytes()[..], &[0xff, 0xfe]].concat()), INFO, ["header"];
        "a shape with a product past 2^64",
            header("{\"w\":{\"dtype\":\"F32\",\"shape\":[4294967296,4294967296,4294967296],\"data_offsets\":[0,4]}}", 4),
            INFO, ["header"];
        "a shape of another size than its data",
            header("{\"w\":{\"dtype\":\"F32\",\"shape\":[3],\"data_offsets\":[0,4]}}", 4), INFO, ["header"];
        "tensors that overlap",
            header("{\"a\":{\"dtype\":\"F32\",\"shape\":[2],\"data_offsets\":[0,8]},\
                    \"b\":{\"dtype\":\"F32\",\"shape\":[2],\"data_offsets\":[4,12]}}", 12),
            INFO, ["header"];
        "16-bit floats", header("{\"w\":{\"dtype\":\"F16\",\"shape\":[2],\"data_offsets\":[0,4]}}", 4),
            INFO, ["tensor w", "F16", "F32"];
        "arrays a thousand deep in the header", |d| {
            let text = "[".repeat(1000);
            put(d.join("w.safetensors"), [&1000u64.to_le_bytes(), text.as_bytes()].concat());
        }, INFO, ["header"];
        "to start from: cut", then(scan_toml, changed(weights, "w.safetensors", cut_end(1))),
            INIT, ["w.safetensors", "header"];
        "to start from: not there", then(scan_toml, |_| ()), INIT, ["w.safetensors"];
        "to start from: tensors of another network", then(scan_toml, weights),
            INIT, ["w.safetensors", "expected a tensor of shape"];
        "checkpoint: empty", run(|d| put(d.join("c.safetensors"), "")),
            RESUME, ["checkpoint.safetensors", "header length"];
        "checkpoint: a value changed", run(changed(checkpoint, "c.safetensors", |b| {
            let n = b.len();
            b[n - 1] ^= 1;
        })), RESUME, ["crc32"];
        "checkpoint: weights in its place", run(|d| {
            weights(d);
            std::fs::rename(d.join("w.safetensors"), d.join("c.safetensors")).unwrap();
        }), RESUME, ["checkpoint.safetensors", "format"];
        "checkpoint: of another run", run(checkpoint), RESUME, ["checkpoint.safetensors", "--resume"];
        "checkpoint: none", then(scan_toml, |_| ()), RESUME, ["no checkpoint"];
    }
}
