//! Numbers as files store them.

use std::io::Write;

/// Storage type of a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Number {
    Bool,
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    U64,
    I64,
    F32,
    F64,
}

impl std::fmt::Display for Number {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let kind = match self {
            Self::Bool => return f.write_str("booleans"),
            Self::U8 | Self::U16 | Self::U32 | Self::U64 => "unsigned integers",
            Self::I8 | Self::I16 | Self::I32 | Self::I64 => "signed integers",
            Self::F32 | Self::F64 => "floats",
        };
        write!(f, "{}-bit {kind}", 8 * self.bytes())
    }
}

/// Byte order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ByteOrder {
    Little,
    Big,
}

impl Number {
    /// Numbers of `bytes` bytes: unsigned (`u`) or signed integers (`i`), floats (`f`), or booleans (`b`).
    pub fn of(kind: char, bytes: usize) -> Option<Self> {
        Some(match (kind, bytes) {
            ('b', 1) => Self::Bool,
            ('u', 1) => Self::U8,
            ('i', 1) => Self::I8,
            ('u', 2) => Self::U16,
            ('i', 2) => Self::I16,
            ('u', 4) => Self::U32,
            ('i', 4) => Self::I32,
            ('u', 8) => Self::U64,
            ('i', 8) => Self::I64,
            ('f', 4) => Self::F32,
            ('f', 8) => Self::F64,
            _ => return None,
        })
    }

    /// Bytes per number.
    pub fn bytes(self) -> usize {
        match self {
            Self::Bool | Self::U8 | Self::I8 => 1,
            Self::U16 | Self::I16 => 2,
            Self::U32 | Self::I32 | Self::F32 => 4,
            Self::U64 | Self::I64 | Self::F64 => 8,
        }
    }

    /// Appends the numbers in `raw` (a whole number of them) to `out`.
    pub fn singles(self, order: ByteOrder, raw: &[u8], out: &mut Vec<f32>) {
        self.decode(order, raw, out, |x| x as f32);
    }

    /// Appends the numbers in `raw` (a whole number of them) to `out`.
    pub fn doubles(self, order: ByteOrder, raw: &[u8], out: &mut Vec<f64>) {
        self.decode(order, raw, out, |x| x);
    }

    /// Appends what `map` makes of the numbers in `raw` (a whole number of them) to `out`.
    fn decode<T>(self, order: ByteOrder, raw: &[u8], out: &mut Vec<T>, map: impl Fn(f64) -> T) {
        macro_rules! each {
            ($t:ty) => {{
                let (raw, _) = raw.as_chunks::<{ size_of::<$t>() }>();
                match order {
                    ByteOrder::Little => out.extend(raw.iter().map(|b| map(<$t>::from_le_bytes(*b) as f64))),
                    ByteOrder::Big => out.extend(raw.iter().map(|b| map(<$t>::from_be_bytes(*b) as f64))),
                }
            }};
        }
        match self {
            Self::Bool => out.extend(raw.iter().map(|b| map(if *b == 0 { 0.0 } else { 1.0 }))),
            Self::U8 => each!(u8),
            Self::I8 => each!(i8),
            Self::U16 => each!(u16),
            Self::I16 => each!(i16),
            Self::U32 => each!(u32),
            Self::I32 => each!(i32),
            Self::U64 => each!(u64),
            Self::I64 => each!(i64),
            Self::F32 => each!(f32),
            Self::F64 => each!(f64),
        }
    }
}

/// Writes `values`, little-endian.
pub(crate) fn write(w: &mut dyn Write, values: &[f32]) -> std::io::Result<()> {
    let mut raw = [[0; 4]; 1 << 14];
    for part in values.chunks(raw.len()) {
        let raw = &mut raw[..part.len()];
        raw.iter_mut().zip(part).for_each(|(raw, x)| *raw = x.to_le_bytes());
        w.write_all(raw.as_flattened())?;
    }
    Ok(())
}
