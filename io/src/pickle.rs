//! A reader of Python's pickle, protocols 2 to 5, as pure data.
//!
//! A pickle is a program for a stack machine that may call anything. This machine supports numbers, texts, bytes,
//! tuples, lists, dicts and the names that NumPy's arrays need (`numpy.rs`); it refuses every other name or opcode by
//! name and calls nothing. Texts, bytes and arrays stay in the file's bytes until they are read, so a file cannot claim
//! more than it holds. Values that the file uses repeatedly are kept once.

mod numpy;
mod op;
mod value;
mod write;

#[cfg(test)]
mod tests;

use conefield_core::{Error, Result, files};
use numpy::{Array, Dtype, Global};
use std::collections::HashMap;
use std::io::Read;
use std::path::Path;
use value::{Heap, Node, Refusal, Value};

pub(crate) use value::{Item, Pickle};
pub(crate) use write::{Out, write};

/// Most values in a pickle: a hundred times what long lists of angles need.
const MOST_VALUES: usize = 1 << 22;

/// Most memo entries.
const MOST_MEMO: usize = 1 << 20;

/// Most keys of a dict, because lookups are linear.
const MOST_KEYS: usize = 1 << 10;

/// Longest integer, in bytes.
const LONGEST_INTEGER: usize = 16;

const PROTOCOLS: std::ops::RangeInclusive<u8> = 2..=5;

/// Whether `start`, the first bytes of a file, are those of a pickle of protocol 2 or later.
pub(crate) fn is_start(start: &[u8]) -> bool {
    // Python's current protocol is 5; a few later ones are accepted here so that the refusal can name them.
    matches!(start, [op::PROTO, 0..=15, ..])
}

/// Whether the file starts like a pickle of protocol 2 or later.
pub(crate) fn is_pickle(path: &Path) -> Result<bool> {
    let mut start = Vec::new();
    let (file, _) = files::open(path)?;
    file.take(2).read_to_end(&mut start).map_err(|e| Error::io(path, e))?;
    Ok(is_start(&start))
}

impl<'a> Pickle<'a> {
    /// Reads `bytes`, the content of the file `place`.
    pub fn parse(place: &str, bytes: &'a [u8]) -> Result<Self> {
        let mut machine = Machine { place, bytes, ..Machine::default() };
        let top = machine.run()?;
        machine.heap.check_nesting(top).map_err(|r| Error::invalid(place, "content", r.found, r.expected))?;
        Ok(Self { place: place.to_owned(), heap: machine.heap, top })
    }
}

#[derive(Default)]
struct Machine<'p, 'a> {
    place: &'p str,
    bytes: &'a [u8],
    /// Position of the next byte.
    at: usize,
    /// Position of the current opcode.
    start: usize,
    stack: Vec<Value<'a>>,
    /// Heights of the stack at the open marks.
    marks: Vec<usize>,
    memo: HashMap<u64, Value<'a>>,
    heap: Heap<'a>,
    /// Values created so far.
    made: usize,
    /// Bytes created by `_codecs.encode` so far.
    encoded: usize,
}

impl<'a> Machine<'_, 'a> {
    fn run(&mut self) -> Result<Value<'a>> {
        let first = self.byte()?;
        if first != op::PROTO {
            return Err(self.wrong(format!("0x{first:02x}"), "0x80, the start of a pickle of protocol 2 or later"));
        }
        self.protocol()?;
        loop {
            self.start = self.at;
            match self.byte()? {
                op::STOP => break,
                code => self.step(code)?,
            }
        }
        let top = self.pop()?;
        if !self.stack.is_empty() || !self.marks.is_empty() {
            return Err(self.wrong(format!("{} values left over", self.stack.len()), "one value at the end"));
        }
        if self.at != self.bytes.len() {
            let found = format!("{} bytes after the end", self.bytes.len() - self.at);
            return Err(self.wrong(found, "the end of the file"));
        }
        Ok(top)
    }

    fn protocol(&mut self) -> Result<()> {
        let version = self.byte()?;
        if PROTOCOLS.contains(&version) {
            return Ok(());
        }
        Err(self.wrong(format!("protocol {version}"), format!("{} to {}", PROTOCOLS.start(), PROTOCOLS.end())))
    }

    fn step(&mut self, code: u8) -> Result<()> {
        match code {
            op::NONE => self.push(Value::None),
            op::NEWTRUE => self.push(Value::Bool(true)),
            op::NEWFALSE => self.push(Value::Bool(false)),
            op::BININT => self.take(4).and_then(|raw| self.signed(raw)),
            op::BININT1 => self.unsigned(1).and_then(|x| self.push(Value::Int(x.into()))),
            op::BININT2 => self.unsigned(2).and_then(|x| self.push(Value::Int(x.into()))),
            op::LONG1 => self.counted(1).and_then(|raw| self.signed(raw)),
            op::LONG4 => self.counted(4).and_then(|raw| self.signed(raw)),
            // The only number that is big-endian.
            op::BINFLOAT => self.unsigned(8).and_then(|x| self.push(Value::Float(f64::from_bits(x.swap_bytes())))),
            op::SHORT_BINUNICODE => self.text(1),
            op::BINUNICODE => self.text(4),
            op::BINUNICODE8 => self.text(8),
            op::SHORT_BINBYTES | op::SHORT_BINSTRING => self.binary(1),
            op::BINBYTES | op::BINSTRING => self.binary(4),
            op::BINBYTES8 | op::BYTEARRAY8 => self.binary(8),

            op::EMPTY_TUPLE => self.tuple(0),
            op::TUPLE1 => self.tuple(1),
            op::TUPLE2 => self.tuple(2),
            op::TUPLE3 => self.tuple(3),
            op::TUPLE => self.above_mark().and_then(|items| self.make(Node::Tuple(items))),
            op::EMPTY_LIST => self.make(Node::List(Vec::new())),
            op::LIST => self.above_mark().and_then(|items| self.make(Node::List(items))),
            op::APPEND => self.pop().and_then(|item| self.append(vec![item])),
            op::APPENDS => self.above_mark().and_then(|items| self.append(items)),
            op::EMPTY_DICT => self.make(Node::Dict(Vec::new())),
            op::DICT => {
                let items = self.above_mark()?;
                self.make(Node::Dict(Vec::new()))?;
                self.set_items(items)
            }
            op::SETITEM => {
                let value = self.pop()?;
                let key = self.pop()?;
                self.set_items(vec![key, value])
            }
            op::SETITEMS => self.above_mark().and_then(|items| self.set_items(items)),

            op::PROTO => self.protocol(),
            op::FRAME => self.unsigned(8).and_then(|length| self.within(length)),
            op::MARK => {
                self.count_value()?;
                self.marks.push(self.stack.len());
                Ok(())
            }
            op::POP => self.pop_or_mark(),
            op::POP_MARK => self.above_mark().map(drop),
            op::DUP => self.peek().and_then(|value| self.push(value)),

            op::MEMOIZE => self.remember(self.memo.len() as u64),
            op::BINPUT => self.unsigned(1).and_then(|index| self.remember(index)),
            op::LONG_BINPUT => self.unsigned(4).and_then(|index| self.remember(index)),
            op::BINGET => self.unsigned(1).and_then(|index| self.recall(index)),
            op::LONG_BINGET => self.unsigned(4).and_then(|index| self.recall(index)),

            op::GLOBAL => {
                let (module, name) = (self.line()?, self.line()?);
                self.global(module, name)
            }
            op::STACK_GLOBAL => {
                let (name, module) = (self.pop()?, self.pop()?);
                match (self.heap.text(module), self.heap.text(name)) {
                    (Some(module), Some(name)) => self.global(module, name),
                    _ => Err(self.wrong(self.heap.kind(name), "a module and a name")),
                }
            }
            op::REDUCE => self.reduce(),
            op::BUILD => self.build(),

            op::PERSID
            | op::BINPERSID
            | op::EXT1
            | op::EXT2
            | op::EXT4
            | op::NEWOBJ
            | op::NEWOBJ_EX
            | op::INST
            | op::OBJ
            | op::NEXT_BUFFER
            | op::READONLY_BUFFER => {
                Err(self.wrong("an opcode that refers to something outside or makes an object", "data only"))
            }
            op::EMPTY_SET | op::ADDITEMS | op::FROZENSET => Err(self.wrong("a set", "a list, tuple or dict")),
            op::INT | op::LONG | op::FLOAT | op::STRING | op::UNICODE | op::GET | op::PUT => {
                Err(self.wrong("an opcode of protocol 0", "protocol 2 or later: write the file with Python 3"))
            }
            other => Err(self.wrong(format!("0x{other:02x}"), "an opcode of protocols 2 to 5")),
        }
    }

    /// An error at the current opcode.
    fn wrong(&self, found: impl ToString, expected: impl ToString) -> Error {
        let name = self.bytes.get(self.start).and_then(|c| op::name(*c));
        let field = match name {
            Some(name) => format!("byte {} ({name})", self.start),
            None => format!("byte {}", self.start),
        };
        Error::invalid(self.place, field, found, expected)
    }

    fn refuse(&self, refusal: Refusal) -> Error {
        self.wrong(refusal.found, refusal.expected)
    }

    fn left(&self) -> usize {
        self.bytes.len() - self.at
    }

    fn within(&self, length: u64) -> Result<()> {
        if length > self.left() as u64 {
            let found = format!("the end of the file after {} bytes", self.left());
            return Err(self.wrong(found, format!("{length} bytes")));
        }
        Ok(())
    }

    fn take(&mut self, length: u64) -> Result<&'a [u8]> {
        self.within(length)?;
        let taken = &self.bytes[self.at..self.at + length as usize];
        self.at += taken.len();
        Ok(taken)
    }

    fn byte(&mut self) -> Result<u8> {
        self.take(1).map(|raw| raw[0])
    }

    /// A number of `bytes` bytes, at most 8.
    fn unsigned(&mut self, bytes: u64) -> Result<u64> {
        Ok(self.take(bytes)?.iter().rev().fold(0, |n, b| n << 8 | u64::from(*b)))
    }

    /// The bytes behind a length of `bytes` bytes.
    fn counted(&mut self, bytes: u64) -> Result<&'a [u8]> {
        let length = self.unsigned(bytes)?;
        self.take(length)
    }

    fn line(&mut self) -> Result<&'a str> {
        let rest = &self.bytes[self.at..];
        let end = rest.iter().position(|b| *b == b'\n').ok_or_else(|| self.wrong("the end of the file", "a line"))?;
        self.at += end + 1;
        std::str::from_utf8(&rest[..end]).map_err(|e| self.wrong(format!("a name that is no UTF-8: {e}"), "a name"))
    }

    fn count_value(&mut self) -> Result<()> {
        self.made += 1;
        if self.made > MOST_VALUES {
            return Err(self.wrong(format!("more than {MOST_VALUES} values"), "long data in NumPy arrays"));
        }
        Ok(())
    }

    fn push(&mut self, value: Value<'a>) -> Result<()> {
        self.count_value()?;
        self.stack.push(value);
        Ok(())
    }

    fn make(&mut self, node: Node<'a>) -> Result<()> {
        self.push(Value::Node(self.heap.nodes.len()))?;
        self.heap.nodes.push(node);
        Ok(())
    }

    /// The top of the stack; values below an open mark are out of reach.
    fn peek(&self) -> Result<Value<'a>> {
        let floor = self.marks.last().copied().unwrap_or(0);
        match self.stack.last() {
            Some(value) if self.stack.len() > floor => Ok(*value),
            _ => Err(self.wrong("an empty stack", "a value on it")),
        }
    }

    fn pop(&mut self) -> Result<Value<'a>> {
        let value = self.peek()?;
        self.stack.pop();
        Ok(value)
    }

    /// As in Python, POP removes an open mark if nothing lies above it.
    fn pop_or_mark(&mut self) -> Result<()> {
        if self.marks.last() == Some(&self.stack.len()) {
            self.marks.pop();
            return Ok(());
        }
        self.pop().map(|_| ())
    }

    fn above_mark(&mut self) -> Result<Vec<Value<'a>>> {
        match self.marks.pop() {
            Some(mark) if mark <= self.stack.len() => Ok(self.stack.split_off(mark)),
            _ => Err(self.wrong("no open mark", "a mark")),
        }
    }

    fn tuple(&mut self, n: usize) -> Result<()> {
        let mut items = (0..n).map(|_| self.pop()).collect::<Result<Vec<_>>>()?;
        items.reverse();
        self.make(Node::Tuple(items))
    }

    /// Pushes an integer in two's complement.
    fn signed(&mut self, raw: &[u8]) -> Result<()> {
        if raw.len() > LONGEST_INTEGER {
            let expected = format!("at most {LONGEST_INTEGER} bytes");
            return Err(self.wrong(format!("an integer of {} bytes", raw.len()), expected));
        }
        // Sign extension of the last byte.
        let sign = if raw.last().is_some_and(|b| b & 0x80 != 0) { 0xff } else { 0 };
        let mut whole = [sign; LONGEST_INTEGER];
        whole[..raw.len()].copy_from_slice(raw);
        self.push(Value::Int(i128::from_le_bytes(whole)))
    }

    /// Pushes a text behind a length of `bytes` bytes.
    fn text(&mut self, bytes: u64) -> Result<()> {
        let raw = self.counted(bytes)?;
        let text = std::str::from_utf8(raw).map_err(|e| self.wrong(format!("no UTF-8: {e}"), "UTF-8 text"))?;
        self.push(Value::Text(text))
    }

    fn binary(&mut self, bytes: u64) -> Result<()> {
        let raw = self.counted(bytes)?;
        self.push(Value::Bytes(raw))
    }

    fn remember(&mut self, index: u64) -> Result<()> {
        let value = self.peek()?;
        if self.memo.len() >= MOST_MEMO && !self.memo.contains_key(&index) {
            return Err(self.wrong(format!("more than {MOST_MEMO} numbered values"), "fewer"));
        }
        self.memo.insert(index, value);
        Ok(())
    }

    fn recall(&mut self, index: u64) -> Result<()> {
        match self.memo.get(&index) {
            Some(value) => self.push(*value),
            None => Err(self.wrong(format!("number {index}"), "a value that was numbered before")),
        }
    }

    fn append(&mut self, items: Vec<Value<'a>>) -> Result<()> {
        let list = self.peek()?;
        match self.node_mut(list) {
            Some(Node::List(all)) => {
                all.extend(items);
                Ok(())
            }
            _ => Err(self.wrong(self.heap.kind(list), "a list to append to")),
        }
    }

    fn set_items(&mut self, items: Vec<Value<'a>>) -> Result<()> {
        let (pairs, rest) = items.as_chunks::<2>();
        if !rest.is_empty() {
            return Err(self.wrong("a key without a value", "pairs of key and value"));
        }
        let dict = self.peek()?;
        match self.node_mut(dict) {
            Some(Node::Dict(all)) if all.len() + pairs.len() > MOST_KEYS => {
                let found = format!("a dict of {} keys or more", all.len() + pairs.len());
                Err(self.wrong(found, format!("at most {MOST_KEYS}: a scan has a dozen")))
            }
            Some(Node::Dict(all)) => {
                all.extend(pairs.iter().map(|[k, v]| (*k, *v)));
                Ok(())
            }
            _ => Err(self.wrong(self.heap.kind(dict), "a dict to add to")),
        }
    }

    fn node_mut(&mut self, value: Value<'a>) -> Option<&mut Node<'a>> {
        match value {
            Value::Node(n) => self.heap.nodes.get_mut(n),
            _ => None,
        }
    }

    fn global(&mut self, module: &str, name: &str) -> Result<()> {
        let global = Global::find(module, name).map_err(|r| self.refuse(r))?;
        self.push(Value::Global(global))
    }

    /// REDUCE, which calls a function in Python: creates the objects of the few known names.
    fn reduce(&mut self) -> Result<()> {
        let arguments = self.pop()?;
        let Value::Global(global) = self.pop()? else {
            return Err(self.wrong("a call of something that is no name", "data only"));
        };
        match global {
            Global::Reconstruct => match self.heap.tuple(arguments) {
                Some([Value::Global(Global::Ndarray), _, _]) => self.make(Node::Array(None)),
                _ => Err(self.wrong(self.heap.kind(arguments), "numpy.ndarray with a shape and a type")),
            },
            Global::FromBuffer => {
                let array = Array::from_buffer(&self.heap, arguments).map_err(|r| self.refuse(r))?;
                self.make(Node::Array(Some(array)))
            }
            Global::Dtype => {
                let name = self.heap.items(arguments).and_then(|a| self.heap.text(*a.first()?));
                let name = name.ok_or_else(|| self.wrong(self.heap.kind(arguments), "the name of a dtype"))?;
                let dtype = Dtype::named(name).map_err(|r| self.refuse(r))?;
                self.make(Node::Dtype(dtype))
            }
            Global::Scalar => {
                let value = numpy::scalar(&self.heap, arguments).map_err(|r| self.refuse(r))?;
                self.push(value)
            }
            Global::Encode => self.encode(arguments),
            Global::Ndarray => Err(self.wrong(format!("a call of {}", global.name()), "data only")),
        }
    }

    /// Protocol 2 has no bytes: Python writes them as text and decodes it with `_codecs.encode`.
    fn encode(&mut self, arguments: Value<'a>) -> Result<()> {
        let text = match self.heap.tuple(arguments) {
            Some([Value::Text(text), codec]) if matches!(self.heap.text(codec), Some("latin1" | "latin-1")) => text,
            _ => return Err(self.wrong(self.heap.kind(arguments), "a text and \"latin1\"")),
        };
        // Encoding one text repeatedly would create more than the file holds.
        self.encoded += text.len();
        if self.encoded > self.bytes.len() {
            return Err(self.wrong("the same text encoded again and again", "every text at most once"));
        }
        let bytes = text.chars().map(|c| u8::try_from(u32::from(c)).ok()).collect::<Option<Vec<u8>>>();
        let bytes = bytes.ok_or_else(|| self.wrong("a character past U+00FF", "bytes as text"))?;
        self.make(Node::Encoded(bytes))
    }

    fn build(&mut self) -> Result<()> {
        let state = self.pop()?;
        let object = self.peek()?;
        let built = match self.heap.node(object) {
            Some(Node::Dtype(d)) => d.with_state(&self.heap, state).map(Node::Dtype),
            Some(Node::Array(None)) => Array::from_state(&self.heap, state).map(|a| Node::Array(Some(a))),
            _ => Err(Refusal::new(self.heap.kind(object), "an array or a dtype to set the state of")),
        };
        let built = built.map_err(|r| self.refuse(r))?;
        if let Some(node) = self.node_mut(object) {
            *node = built;
        }
        Ok(())
    }
}
