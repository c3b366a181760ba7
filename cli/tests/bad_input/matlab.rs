//! `.mat`, through a scanner's description.

use crate::case::{Case, changed, cut, cut_end, put, table, then};
use conefield_tests::hostile::seeds::{CIRCLE, scanner_mat, scanner_mat_packed, scanner_toml};
use std::path::Path;

const IMPORT: &str = "import scanner.toml -o scan";
const FILE: &str = "counts.mat";

fn named(seed: fn(&Path), name: &'static str) -> impl Fn(&Path) + Sync + Send {
    then(seed, move |d| put(d.join("scanner.toml"), scanner_toml(name, CIRCLE)))
}

pub fn cases() -> Vec<Case> {
    table! {
        "cut within the header", changed(scanner_mat, FILE, cut(100)), IMPORT, [FILE, "header"];
        "cut within the numbers", changed(scanner_mat, FILE, cut_end(30)), IMPORT, [FILE, "counts"];
        "a wrong byte order", changed(scanner_mat, FILE, |b| b[126] = b'X'), IMPORT, [FILE, "byte order", "49 4d (IM)"];
        "an element past the end", changed(scanner_mat, FILE, |b| b[132..136].fill(0xff)), IMPORT, [FILE];
        "a packed variable that is damaged", changed(scanner_mat_packed, FILE, |b| b[150] ^= 0x55), IMPORT, [FILE];
        "dimensions whose product is past 2^64", changed(scanner_mat, FILE, |b| {
            // Behind the header: the tags of the variable and its flags, the flags, the tag of the dimensions.
            b[160..172].fill(0x7f);
        }), IMPORT, [FILE];
        "a variable that the file lacks", named(scanner_mat, "counts.mat:flat"), IMPORT, ["no variable \"flat\"", "counts"];
        "a field that the struct lacks", named(scanner_mat_packed, "counts.mat:scan.flat"), IMPORT,
            ["no field \"flat\"", "counts, angles"];
        "a struct instead of numbers", named(scanner_mat_packed, "counts.mat:scan"), IMPORT, ["a struct", "counts, angles"];
        "a text instead of numbers", named(scanner_mat_packed, "counts.mat:name"), IMPORT, ["text", "real numbers"];
        "two variables and no name", named(scanner_mat_packed, FILE), IMPORT, ["2 variables", "FILE.mat:NAME"];
    }
}
