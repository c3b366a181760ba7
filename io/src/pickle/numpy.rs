//! The few names that a pickle may use, and the values they create. None is ever called: each is a rule for data.

use super::value::{Heap, Node, Refusal, Value};
use crate::npy::element;
use crate::number::{ByteOrder, Number};

/// More axes than any scan or volume has.
const MOST_AXES: usize = 8;

/// A name that a pickle may use.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Global {
    Reconstruct,
    Ndarray,
    Dtype,
    Scalar,
    FromBuffer,
    Encode,
}

/// The names, as NumPy 1 has them.
const NAMES: [(&str, Global); 6] = [
    ("numpy.ndarray", Global::Ndarray),
    ("numpy.dtype", Global::Dtype),
    ("numpy.core.multiarray._reconstruct", Global::Reconstruct),
    ("numpy.core.multiarray.scalar", Global::Scalar),
    ("numpy.core.numeric._frombuffer", Global::FromBuffer),
    ("_codecs.encode", Global::Encode),
];

impl Global {
    pub fn find(module: &str, name: &str) -> Result<Self, Refusal> {
        let refused = || {
            let shown = |t: &str| t.chars().take(60).flat_map(char::escape_debug).collect::<String>();
            let expected = "data only: the names that NumPy's arrays, dtypes and numbers need";
            Refusal::new(format!("the name {}.{}", shown(module), shown(name)), expected)
        };
        // No known name is longer; a copy of a huge one would take memory.
        if module.len() + name.len() > 60 {
            return Err(refused());
        }
        // NumPy 2 renamed its core.
        let whole = match module.strip_prefix("numpy._core.") {
            Some(part) => format!("numpy.core.{part}.{name}"),
            None => format!("{module}.{name}"),
        };
        NAMES.iter().find(|(known, _)| *known == whole).map(|(_, global)| *global).ok_or_else(refused)
    }

    pub fn name(self) -> &'static str {
        NAMES.iter().find(|(_, global)| *global == self).map_or("unknown", |(name, _)| name)
    }
}

/// How a NumPy array stores numbers.
#[derive(Debug, Clone, Copy)]
pub(super) struct Dtype {
    number: Number,
    order: ByteOrder,
}

impl Dtype {
    /// From NumPy's name of the type, e.g. `f4`.
    pub fn named(name: &str) -> Result<Self, Refusal> {
        // Cut: a file may hold a text of any length.
        let shown: String = name.chars().take(20).collect();
        let object = name.trim_start_matches(['|', '<', '>', '=']).starts_with('O');
        let expected = "numbers: objects would have to be made by calls";
        Refusal::unless(!object, format!("the object dtype \"{shown}\""), expected)?;
        let expected = "real numbers: b1, i1 to i8, u1 to u8, f4 or f8";
        let (number, order) = element(name).ok_or_else(|| Refusal::new(format!("the dtype \"{shown}\""), expected))?;
        Ok(Self { number, order })
    }

    /// Applies the state that NumPy adds: (version, byte order, subarray, names, fields, ...).
    pub fn with_state<'a>(self, heap: &Heap<'a>, state: Value<'a>) -> Result<Self, Refusal> {
        let wrong = || Refusal::new(heap.kind(state), "the state of a dtype of plain numbers");
        let Some([_, order, subarray, names, fields, ..]) = heap.items(state) else { return Err(wrong()) };
        let plain = [subarray, names, fields].iter().all(|v| matches!(v, Value::None));
        Refusal::unless(plain, "a dtype with fields or a subarray", "a dtype of plain numbers")?;
        let order = match heap.text(*order) {
            Some("<") => ByteOrder::Little,
            Some(">") => ByteOrder::Big,
            Some("|" | "=") => self.order,
            _ => return Err(wrong()),
        };
        Ok(Self { order, ..self })
    }
}

/// An array whose numbers are still in the file's bytes.
#[derive(Debug)]
pub(super) struct Array<'a> {
    dtype: Dtype,
    /// Lengths in storage order, slowest first.
    pub stored: Vec<usize>,
    /// Axis `k` of the array is axis `axes[k]` of the storage.
    pub axes: Vec<usize>,
    pub count: usize,
    data: Value<'a>,
}

impl<'a> Array<'a> {
    pub fn shape(&self) -> Vec<usize> {
        self.axes.iter().map(|&a| self.stored[a]).collect()
    }

    /// Appends the numbers as `f32`, in storage order.
    pub fn singles(&self, heap: &Heap<'a>, out: &mut Vec<f32>) {
        self.dtype.number.singles(self.dtype.order, heap.bytes(self.data).unwrap_or_default(), out);
    }

    /// The numbers in storage order.
    pub fn numbers(&self, heap: &Heap<'a>) -> Vec<f64> {
        let mut out = Vec::new();
        self.dtype.number.doubles(self.dtype.order, heap.bytes(self.data).unwrap_or_default(), &mut out);
        out
    }

    /// From the state of an `ndarray`: (version, shape, dtype, Fortran order, data).
    pub fn from_state(heap: &Heap<'a>, state: Value<'a>) -> Result<Self, Refusal> {
        let wrong = || Refusal::new(heap.kind(state), "the state of an array: version, shape, dtype, order, data");
        let [_, shape, dtype, fortran, data] = heap.tuple(state).ok_or_else(wrong)?;
        let fortran = match fortran {
            Value::Bool(b) => b,
            Value::Int(i) => i != 0,
            _ => return Err(wrong()),
        };
        Self::new(heap, data, dtype, shape, fortran)
    }

    /// From the arguments of `_frombuffer`: data, dtype, shape, order and optionally the axes for order "K".
    pub fn from_buffer(heap: &Heap<'a>, arguments: Value<'a>) -> Result<Self, Refusal> {
        let wrong = || Refusal::new(heap.kind(arguments), "data, dtype, shape and order of an array");
        let (data, dtype, shape, order, axes) = match heap.items(arguments) {
            Some(&[data, dtype, shape, order]) => (data, dtype, shape, order, Value::None),
            Some(&[data, dtype, shape, order, axes]) => (data, dtype, shape, order, axes),
            _ => return Err(wrong()),
        };
        let mut array = match heap.text(order) {
            Some("C" | "K") => Self::new(heap, data, dtype, shape, false)?,
            Some("F") => Self::new(heap, data, dtype, shape, true)?,
            _ => return Err(Refusal::new(heap.kind(order), "\"C\", \"F\" or \"K\", the order of an array")),
        };
        if heap.text(order) == Some("K") && !matches!(axes, Value::None) {
            array.axes = lengths(heap, axes)?;
            let mut sorted = array.axes.clone();
            sorted.sort_unstable();
            if !sorted.into_iter().eq(0..array.stored.len()) {
                return Err(Refusal::new(format!("{:?}", array.axes), "each axis of the array once"));
            }
        }
        Ok(array)
    }

    fn new(
        heap: &Heap<'a>,
        data: Value<'a>,
        dtype: Value<'a>,
        shape: Value<'a>,
        fortran: bool,
    ) -> Result<Self, Refusal> {
        let Some(&Node::Dtype(dtype)) = heap.node(dtype) else {
            return Err(Refusal::new(heap.kind(dtype), "a dtype"));
        };
        let raw = heap.bytes(data).ok_or_else(|| Refusal::new(heap.kind(data), "the bytes of an array"))?;
        let mut stored = match shape {
            Value::Int(_) => vec![length(shape).ok_or_else(|| Refusal::new(heap.kind(shape), "a length"))?],
            _ => lengths(heap, shape)?,
        };
        let bytes = stored.iter().try_fold(dtype.number.bytes(), |n, &s| n.checked_mul(s));
        let expected = format!("what {stored:?} numbers of {} bytes take", dtype.number.bytes());
        Refusal::unless(bytes == Some(raw.len()), format!("{} bytes of data", raw.len()), expected)?;
        let mut axes: Vec<usize> = (0..stored.len()).collect();
        if fortran {
            stored.reverse();
            axes.reverse();
        }
        Ok(Self { dtype, stored, axes, count: raw.len() / dtype.number.bytes(), data })
    }
}

/// The value of a NumPy scalar: (dtype, data).
pub(super) fn scalar<'a>(heap: &Heap<'a>, arguments: Value<'a>) -> Result<Value<'a>, Refusal> {
    let wrong = || Refusal::new(heap.kind(arguments), "dtype and data of a number");
    let [dtype, data] = heap.tuple(arguments).ok_or_else(wrong)?;
    let (Some(Node::Dtype(dtype)), Some(raw)) = (heap.node(dtype), heap.bytes(data)) else { return Err(wrong()) };
    let (found, wanted) = (raw.len(), dtype.number.bytes());
    Refusal::unless(found == wanted, format!("{found} bytes"), format!("{wanted} bytes for one number"))?;
    let mut out = Vec::new();
    dtype.number.doubles(dtype.order, raw, &mut out);
    match (dtype.number, out.first()) {
        (Number::Bool, Some(x)) => Ok(Value::Bool(*x != 0.0)),
        (_, Some(x)) => Ok(Value::Float(*x)),
        _ => Err(wrong()),
    }
}

fn length(value: Value<'_>) -> Option<usize> {
    match value {
        Value::Int(i) => i.try_into().ok(),
        _ => None,
    }
}

fn lengths<'a>(heap: &Heap<'a>, value: Value<'a>) -> Result<Vec<usize>, Refusal> {
    let expected = format!("the lengths of at most {MOST_AXES} axes");
    heap.items(value)
        .filter(|items| items.len() <= MOST_AXES)
        .and_then(|items| items.iter().map(|v| length(*v)).collect())
        .ok_or_else(|| Refusal::new(heap.kind(value), expected))
}
