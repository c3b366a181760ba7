//! Writes plain data and arrays as a pickle of protocol 4, which NumPy 1 and 2 load.

use super::op;
use ndarray::ArrayViewD;
use std::io::{Result, Write};

/// A value to write.
pub(crate) enum Out<'a> {
    None,
    Bool(bool),
    Int(usize),
    Float(f64),
    Text(&'a str),
    List(Vec<Out<'a>>),
    Dict(Vec<(&'a str, Out<'a>)>),
    /// A NumPy array of `f8`.
    Doubles(&'a [f64]),
    /// A NumPy array of `f4` in C order.
    Floats(ArrayViewD<'a, f32>),
}

/// Writes the pickle of one value.
pub(crate) fn write(w: &mut dyn Write, value: &Out<'_>) -> Result<()> {
    w.write_all(&[op::PROTO, 4])?;
    put(w, value)?;
    w.write_all(&[op::STOP])
}

fn put(w: &mut dyn Write, value: &Out<'_>) -> Result<()> {
    match value {
        Out::None => w.write_all(&[op::NONE]),
        Out::Bool(b) => w.write_all(&[if *b { op::NEWTRUE } else { op::NEWFALSE }]),
        Out::Int(i) => integer(w, *i),
        Out::Float(x) => {
            w.write_all(&[op::BINFLOAT])?;
            w.write_all(&x.to_be_bytes())
        }
        Out::Text(t) => text(w, t),
        Out::List(items) => {
            w.write_all(&[op::EMPTY_LIST, op::MARK])?;
            items.iter().try_for_each(|i| put(w, i))?;
            w.write_all(&[op::APPENDS])
        }
        Out::Dict(entries) => {
            w.write_all(&[op::EMPTY_DICT, op::MARK])?;
            for (key, value) in entries {
                text(w, key)?;
                put(w, value)?;
            }
            w.write_all(&[op::SETITEMS])
        }
        Out::Doubles(xs) => {
            array(w, "f8", &[xs.len()], 8, |w| xs.iter().try_for_each(|x| w.write_all(&x.to_le_bytes())))
        }
        Out::Floats(xs) => array(w, "f4", xs.shape(), 4, |w| xs.iter().try_for_each(|x| w.write_all(&x.to_le_bytes()))),
    }
}

fn integer(w: &mut dyn Write, x: usize) -> Result<()> {
    match (u8::try_from(x), i32::try_from(x)) {
        (Ok(x), _) => w.write_all(&[op::BININT1, x]),
        (_, Ok(x)) => {
            w.write_all(&[op::BININT])?;
            w.write_all(&x.to_le_bytes())
        }
        _ => {
            // A ninth byte keeps the sign.
            w.write_all(&[op::LONG1, 9])?;
            w.write_all(&(x as u64).to_le_bytes())?;
            w.write_all(&[0])
        }
    }
}

fn text(w: &mut dyn Write, t: &str) -> Result<()> {
    w.write_all(&[op::BINUNICODE8])?;
    w.write_all(&(t.len() as u64).to_le_bytes())?;
    w.write_all(t.as_bytes())
}

fn global(w: &mut dyn Write, module: &str, name: &str) -> Result<()> {
    text(w, module)?;
    text(w, name)?;
    w.write_all(&[op::STACK_GLOBAL])
}

/// As NumPy writes it: `_reconstruct(ndarray, (0,), b"b")`, then its state. Both versions know the name without the
/// underscore.
fn array(
    w: &mut dyn Write,
    dtype: &str,
    shape: &[usize],
    bytes: usize,
    data: impl Fn(&mut dyn Write) -> Result<()>,
) -> Result<()> {
    global(w, "numpy.core.multiarray", "_reconstruct")?;
    global(w, "numpy", "ndarray")?;
    w.write_all(&[op::BININT1, 0, op::TUPLE1, op::SHORT_BINBYTES, 1, b'b', op::TUPLE3, op::REDUCE])?;
    w.write_all(&[op::MARK, op::BININT1, 1, op::MARK])?;
    shape.iter().try_for_each(|&n| integer(w, n))?;
    w.write_all(&[op::TUPLE])?;
    global(w, "numpy", "dtype")?;
    text(w, dtype)?;
    w.write_all(&[op::NEWFALSE, op::NEWTRUE, op::TUPLE3, op::REDUCE, op::MARK, op::BININT1, 3])?;
    text(w, "<")?;
    w.write_all(&[op::NONE, op::NONE, op::NONE])?;
    for x in [-1i32, -1, 0] {
        w.write_all(&[op::BININT])?;
        w.write_all(&x.to_le_bytes())?;
    }
    w.write_all(&[op::TUPLE, op::BUILD, op::NEWFALSE, op::BINBYTES8])?;
    w.write_all(&((shape.iter().product::<usize>() * bytes) as u64).to_le_bytes())?;
    data(w)?;
    w.write_all(&[op::TUPLE, op::BUILD])
}
