//! The values of a pickle, and access to them.
//!
//! Lists, tuples, dicts and arrays live in one [`Heap`] and are referenced by index: values that occur twice are kept
//! once, a structure that contains itself cannot leak, and nothing is freed by recursion.

use super::numpy::{Array, Dtype, Global};
use crate::memory;
use conefield_core::{Error, Result};
use ndarray::{ArrayD, Dimension};

/// Deeper nesting cannot be a data set.
const DEEPEST: usize = 32;

/// One value; data of variable size is elsewhere.
#[derive(Debug, Clone, Copy)]
pub(super) enum Value<'a> {
    None,
    Bool(bool),
    Int(i128),
    Float(f64),
    /// A slice of the file.
    Text(&'a str),
    /// A slice of the file.
    Bytes(&'a [u8]),
    Global(Global),
    /// An index into the heap.
    Node(usize),
}

#[derive(Debug)]
pub(super) enum Node<'a> {
    Tuple(Vec<Value<'a>>),
    List(Vec<Value<'a>>),
    Dict(Vec<(Value<'a>, Value<'a>)>),
    /// The result of `_codecs.encode`.
    Encoded(Vec<u8>),
    Dtype(Dtype),
    /// `None` until its state is set.
    Array(Option<Array<'a>>),
}

/// Why a value cannot be used.
pub(super) struct Refusal {
    pub found: String,
    pub expected: String,
}

impl Refusal {
    /// A refusal unless `ok`.
    pub fn unless(ok: bool, found: impl ToString, expected: impl ToString) -> Result<(), Self> {
        if ok { Ok(()) } else { Err(Self::new(found, expected)) }
    }

    pub fn new(found: impl ToString, expected: impl ToString) -> Self {
        Self { found: found.to_string(), expected: expected.to_string() }
    }
}

#[derive(Default)]
pub(super) struct Heap<'a> {
    pub nodes: Vec<Node<'a>>,
}

impl<'a> Heap<'a> {
    pub fn node(&self, value: Value<'a>) -> Option<&Node<'a>> {
        match value {
            Value::Node(n) => self.nodes.get(n),
            _ => None,
        }
    }

    /// The items of a tuple or list.
    pub fn items(&self, value: Value<'a>) -> Option<&[Value<'a>]> {
        match self.node(value) {
            Some(Node::Tuple(v) | Node::List(v)) => Some(v),
            _ => None,
        }
    }

    /// The items of a tuple of length `N`.
    pub fn tuple<const N: usize>(&self, value: Value<'a>) -> Option<[Value<'a>; N]> {
        match self.node(value) {
            Some(Node::Tuple(v)) => v.as_slice().try_into().ok(),
            _ => None,
        }
    }

    /// The text; Python 2 wrote its texts as bytes.
    pub fn text(&self, value: Value<'a>) -> Option<&'a str> {
        match value {
            Value::Text(t) => Some(t),
            Value::Bytes(b) => std::str::from_utf8(b).ok(),
            _ => None,
        }
    }

    pub fn bytes<'s>(&'s self, value: Value<'a>) -> Option<&'s [u8]> {
        match (value, self.node(value)) {
            (Value::Bytes(b), _) => Some(b),
            (_, Some(Node::Encoded(b))) => Some(b),
            _ => None,
        }
    }

    /// The kind of value, for errors.
    pub fn kind(&self, value: Value<'a>) -> String {
        let cut =
            |t: &str| if t.chars().count() > 40 { t.chars().take(40).chain(['…']).collect() } else { t.to_owned() };
        match (value, self.node(value)) {
            (Value::None, _) => "None".into(),
            (Value::Bool(b), _) => if b { "True" } else { "False" }.into(),
            (Value::Int(i), _) => i.to_string(),
            (Value::Float(x), _) => x.to_string(),
            (Value::Text(t), _) => format!("\"{}\"", cut(t)),
            (Value::Bytes(b), _) => format!("{} bytes", b.len()),
            (Value::Global(g), _) => format!("the name {}", g.name()),
            (_, Some(Node::Tuple(v))) => format!("a tuple of {}", v.len()),
            (_, Some(Node::List(v))) => format!("a list of {}", v.len()),
            (_, Some(Node::Dict(v))) => format!("a dict of {}", v.len()),
            (_, Some(Node::Encoded(v))) => format!("{} bytes", v.len()),
            (_, Some(Node::Dtype(_))) => "a dtype".into(),
            (_, Some(Node::Array(Some(a)))) => format!("an array of {:?}", a.shape()),
            (_, Some(Node::Array(None))) => "an array without content".into(),
            (Value::Node(_), None) => "nothing".into(),
        }
    }

    fn child(&self, node: usize, index: usize) -> Option<Value<'a>> {
        match self.nodes.get(node)? {
            Node::Tuple(v) | Node::List(v) => v.get(index).copied(),
            Node::Dict(v) => v.get(index / 2).map(|(key, value)| [*key, *value][index % 2]),
            _ => None,
        }
    }

    /// Refuses cycles and too deep nesting below `top`. Not recursive, because the file decides the depth.
    pub fn check_nesting(&self, top: Value<'a>) -> Result<(), Refusal> {
        const ON_PATH: usize = usize::MAX;
        let Value::Node(top) = top else { return Ok(()) };
        let too_deep = || Refusal::new(format!("values nested deeper than {DEEPEST}"), "a flat description of a scan");
        // Levels in and below a node, 0 if not visited yet.
        let mut height = vec![0usize; self.nodes.len()];
        // Node, its next child, levels found below it so far.
        let mut path = vec![(top, 0usize, 0usize)];
        loop {
            let depth = path.len();
            let Some((node, next, below)) = path.last_mut() else { return Ok(()) };
            height[*node] = ON_PATH;
            let Some(child) = self.child(*node, *next) else {
                let (node, levels) = (*node, *below + 1);
                height[node] = levels;
                path.pop();
                if let Some((.., below)) = path.last_mut() {
                    *below = levels.max(*below);
                }
                continue;
            };
            *next += 1;
            let Value::Node(child) = child else { continue };
            match height.get(child) {
                Some(&ON_PATH) => return Err(Refusal::new("a value that holds itself", "values without circles")),
                Some(0) if depth >= DEEPEST => return Err(too_deep()),
                Some(0) => path.push((child, 0, 0)),
                Some(&levels) => {
                    *below = levels.max(*below);
                    if depth + levels > DEEPEST {
                        return Err(too_deep());
                    }
                }
                None => {}
            }
        }
    }
}

/// A parsed pickle.
pub(crate) struct Pickle<'a> {
    pub(super) place: String,
    pub(super) heap: Heap<'a>,
    pub(super) top: Value<'a>,
}

impl<'a> Pickle<'a> {
    /// The pickled value.
    pub fn top(&self) -> Item<'_, 'a> {
        Item { pickle: self, value: self.top, key: String::new() }
    }
}

/// One value of a pickle with its key path.
#[derive(Clone)]
pub(crate) struct Item<'p, 'a> {
    pickle: &'p Pickle<'a>,
    value: Value<'a>,
    key: String,
}

impl<'p, 'a> Item<'p, 'a> {
    /// The key path, joined by dots.
    pub fn key(&self) -> &str {
        if self.key.is_empty() { "content" } else { &self.key }
    }

    /// An error about this value.
    pub fn invalid(&self, found: impl ToString, expected: impl ToString) -> Error {
        Error::invalid(&self.pickle.place, self.key(), found, expected)
    }

    /// An error about this value unless `ok`.
    pub fn ensure(&self, ok: bool, found: impl ToString, expected: impl ToString) -> Result<()> {
        if ok { Ok(()) } else { Err(self.invalid(found, expected)) }
    }

    /// An error about the value at `key`, here or below.
    pub fn invalid_at(&self, key: String, found: impl ToString, expected: impl ToString) -> Error {
        Error::invalid(&self.pickle.place, key, found, expected)
    }

    fn other(&self, expected: impl ToString) -> Error {
        self.invalid(self.pickle.heap.kind(self.value), expected)
    }

    fn entries(&self) -> Result<&'p [(Value<'a>, Value<'a>)]> {
        match self.pickle.heap.node(self.value) {
            Some(Node::Dict(entries)) => Ok(entries),
            _ => Err(self.other("a dict")),
        }
    }

    /// The text keys of a dict.
    pub fn keys(&self) -> Result<Vec<&'a str>> {
        Ok(self.entries()?.iter().filter_map(|(k, _)| self.pickle.heap.text(*k)).collect())
    }

    /// The entry `key` of a dict; `None` if the key is missing or the value is Python's `None`.
    pub fn get(&self, key: &str) -> Result<Option<Self>> {
        // As in Python, the last of equal keys wins.
        let found = self.entries()?.iter().rev().find(|(k, _)| self.pickle.heap.text(*k) == Some(key));
        let path = if self.key.is_empty() { key.to_owned() } else { format!("{}.{key}", self.key) };
        Ok(found.filter(|(_, v)| !matches!(v, Value::None)).map(|(_, value)| Self {
            pickle: self.pickle,
            value: *value,
            key: path,
        }))
    }

    /// A text.
    pub fn text(&self) -> Result<&'a str> {
        self.pickle.heap.text(self.value).ok_or_else(|| self.other("a text"))
    }

    /// A finite number: an int, a float, or an array of one.
    pub fn number(&self) -> Result<f64> {
        let x = match self.numeric(self.value) {
            Some(x) => Some(x),
            None => self.array().filter(|a| a.count == 1).and_then(|a| a.numbers(&self.pickle.heap).first().copied()),
        };
        match x {
            Some(x) if x.is_finite() => Ok(x),
            _ => Err(self.other("a finite number")),
        }
    }

    /// Finite numbers: a list or tuple of them, or an array of one axis.
    pub fn numbers(&self) -> Result<Vec<f64>> {
        let list = |items: &[Value<'a>]| items.iter().map(|v| self.numeric(*v)).collect::<Option<Vec<f64>>>();
        let numbers = match (self.pickle.heap.items(self.value), self.array()) {
            (Some(items), _) => list(items),
            (_, Some(a)) if a.shape().len() == 1 => Some(a.numbers(&self.pickle.heap)),
            _ => None,
        };
        let numbers = numbers.ok_or_else(|| self.other("a list or an array of numbers"))?;
        match numbers.iter().position(|x| !x.is_finite()) {
            Some(i) => Err(self.invalid_at(format!("{}[{i}]", self.key()), numbers[i], "a finite number")),
            None => Ok(numbers),
        }
    }

    /// Exactly `N` finite numbers along `axes`.
    pub fn list<const N: usize>(&self, axes: &str) -> Result<[f64; N]> {
        let expected = format!("{N} numbers, {axes}");
        let count = match (self.pickle.heap.items(self.value), self.array()) {
            (Some(items), _) => items.len(),
            (_, Some(a)) => a.count,
            _ => return Err(self.other(expected)),
        };
        if count != N {
            return Err(self.other(expected));
        }
        self.numbers()?.try_into().map_err(|_| self.other(expected))
    }

    /// The array in C order, if it has this shape; refuses values that are not finite.
    pub fn values(&self, shape: &[usize], meaning: &str) -> Result<ArrayD<f32>> {
        let expected = || format!("an array of {shape:?}, {meaning}");
        let array = self.array().ok_or_else(|| self.other(expected()))?;
        if array.shape() != shape {
            return Err(self.other(expected()));
        }
        let mut values = Vec::new();
        memory::grow(&mut values, array.count, array.count, &self.pickle.place, self.key())?;
        array.singles(&self.pickle.heap, &mut values);
        let values = ArrayD::from_shape_vec(&array.stored[..], values).map_err(|e| self.invalid(e, expected()))?;
        let values = values.permuted_axes(&array.axes[..]);
        let values = memory::in_order(&self.pickle.place, self.key(), values)?;
        memory::all_finite(&self.pickle.place, values, &|at| format!("{}{:?}", self.key(), at.slice()))
    }

    fn numeric(&self, value: Value<'a>) -> Option<f64> {
        match value {
            Value::Int(i) => Some(i as f64),
            Value::Float(x) => Some(x),
            _ => None,
        }
    }

    fn array(&self) -> Option<&'p Array<'a>> {
        match self.pickle.heap.node(self.value) {
            Some(Node::Array(a)) => a.as_ref(),
            _ => None,
        }
    }
}
