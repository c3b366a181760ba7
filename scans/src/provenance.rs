//! Notes on what has been done to a scan.

use conefield_core::scan::Scan;
use serde_json::{Value, json};

/// The entry `key` of the provenance of `scan`, null if it is new. A provenance that is not a table becomes the entry
/// `value` of one.
pub(crate) fn entry<'a>(scan: &'a mut Scan, key: &str) -> &'a mut Value {
    if !scan.provenance.is_object() && !scan.provenance.is_null() {
        scan.provenance = json!({ "value": scan.provenance.take() });
    }
    // Null becomes a table.
    &mut scan.provenance[key]
}
