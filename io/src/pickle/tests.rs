use super::value::{Node, Value};
use super::*;
use crate::testing::says;
use ndarray::{ArrayD, IxDyn, array};

/// `numpy.dtype(name, False, True)` with NumPy's state.
fn dtype(name: &str, order: &str) -> Vec<u8> {
    let mut out = b"cnumpy\ndtype\n".to_vec();
    out.extend([op::SHORT_BINUNICODE, name.len() as u8]);
    out.extend(name.as_bytes());
    out.extend([op::NEWFALSE, op::NEWTRUE, op::TUPLE3, op::REDUCE, op::MARK, op::BININT1, 3, op::SHORT_BINUNICODE, 1]);
    out.extend(order.as_bytes());
    out.extend(b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb");
    out
}

/// An array as NumPy writes it before protocol 5.
fn array_of(module: &str, name: &str, order: &str, shape: &[u8], fortran: bool, data: &[u8]) -> Vec<u8> {
    let mut out = format!("c{module}.multiarray\n_reconstruct\ncnumpy\nndarray\n").into_bytes();
    out.extend(b"K\x00\x85C\x01b\x87R(K\x01(");
    out.extend(shape.iter().flat_map(|n| [op::BININT1, *n]));
    out.push(op::TUPLE);
    out.extend(dtype(name, order));
    out.push(if fortran { op::NEWTRUE } else { op::NEWFALSE });
    out.extend([op::SHORT_BINBYTES, data.len() as u8]);
    out.extend(data);
    out.extend(b"tb");
    out
}

/// A complete pickle of protocol 5.
fn whole(body: &[u8]) -> Vec<u8> {
    [&[op::PROTO, 5], body, b"."].concat()
}

/// The array in the entry `a` of a dict, or at the top.
fn array_in(bytes: &[u8], shape: &[usize]) -> ArrayD<f32> {
    Pickle::parse("a.pickle", bytes).unwrap().top().values(shape, "as the test says").unwrap()
}

fn refused(bytes: &[u8], words: &[&str]) {
    says(Pickle::parse("a.pickle", bytes), &[&["a.pickle", "expected"], words].concat());
}

#[test]
fn orders_and_types_are_read() {
    let want = array![[0.0f32, 1.0, 2.0], [3.0, 4.0, 5.0]].into_dyn();
    for module in ["numpy.core", "numpy._core"] {
        let c: Vec<u8> = (0..6u16).flat_map(|x| x.to_be_bytes()).collect();
        assert_eq!(array_in(&whole(&array_of(module, "u2", ">", &[2, 3], false, &c)), &[2, 3]), want);
        let f: Vec<u8> = [0.0f64, 3.0, 1.0, 4.0, 2.0, 5.0].iter().flat_map(|x| x.to_le_bytes()).collect();
        assert_eq!(array_in(&whole(&array_of(module, "f8", "<", &[2, 3], true, &f)), &[2, 3]), want);
        assert_eq!(array_in(&whole(&array_of(module, "i1", "|", &[2, 3], false, &[0, 1, 2, 3, 4, 5])), &[2, 3]), want);
    }
    let b = whole(&array_of("numpy.core", "b1", "|", &[3], false, &[0, 1, 1]));
    assert_eq!(array_in(&b, &[3]), array![0.0f32, 1.0, 1.0].into_dyn());
}

#[test]
fn what_numpy_wrote_is_read() {
    // np.asfortranarray([[1, 2], [3, 4]]) as u1 by NumPy 1.26, protocol 2: no bytes, but texts to encode.
    let two = b"\x80\x02cnumpy.core.multiarray\n_reconstruct\nq\x00cnumpy\nndarray\nq\x01K\x00\x85q\x02c_codecs\nencode\n\
        q\x03X\x01\x00\x00\x00bq\x04X\x06\x00\x00\x00latin1q\x05\x86q\x06Rq\x07\x87q\x08Rq\t(K\x01K\x02K\x02\x86q\ncnumpy\n\
        dtype\nq\x0bX\x02\x00\x00\x00u1q\x0c\x89\x88\x87q\rRq\x0e(K\x03X\x01\x00\x00\x00|q\x0fNNNJ\xff\xff\xff\xffJ\xff\xff\
        \xff\xffK\x00tq\x10b\x88h\x03X\x04\x00\x00\x00\x01\x03\x02\x04q\x11h\x05\x86q\x12Rq\x13tq\x14b.";
    assert_eq!(array_in(two, &[2, 2]), array![[1.0f32, 2.0], [3.0, 4.0]].into_dyn());
    // np.float64(1.5) by NumPy 2.4, protocol 2; np.float32(1.5), protocol 5.
    let text = b"\x80\x02cnumpy._core.multiarray\nscalar\nq\x00cnumpy\ndtype\nq\x01X\x02\x00\x00\x00f8q\x02\x89\x88\x87q\x03R\
        q\x04(K\x03X\x01\x00\x00\x00<q\x05NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tq\x06bc_codecs\nencode\nq\x07X\t\x00\x00\
        \x00\x00\x00\x00\x00\x00\x00\xc3\xb8?q\x08X\x06\x00\x00\x00latin1q\t\x86q\nRq\x0b\x86q\x0cRq\r.";
    assert_eq!(Pickle::parse("a", text).unwrap().top().number().unwrap(), 1.5);
    let framed = b"\x80\x05\x95e\x00\x00\x00\x00\x00\x00\x00\x8c\x15numpy.core.multiarray\x94\x8c\x06scalar\x94\x93\x94\x8c\
        \x05numpy\x94\x8c\x05dtype\x94\x93\x94\x8c\x02f4\x94\x89\x88\x87\x94R\x94(K\x03\x8c\x01<\x94NNNJ\xff\xff\xff\xffJ\xff\
        \xff\xff\xffK\x00t\x94bC\x04\x00\x00\xc0?\x94\x86\x94R\x94.";
    assert_eq!(Pickle::parse("a", framed).unwrap().top().number().unwrap(), 1.5);
    // np.arange(24).reshape(4, 2, 3).transpose(1, 0, 2) as i1 by NumPy 2.4, protocol 5.
    let turned = b"\x80\x05\x95\x98\x00\x00\x00\x00\x00\x00\x00\x8c\x13numpy._core.numeric\x94\x8c\x0b_frombuffer\x94\x93\x94(\
        \x96\x18\x00\x00\x00\x00\x00\x00\x00\x00\x01\x02\x03\x04\x05\x06\x07\x08\t\n\x0b\x0c\r\x0e\x0f\x10\x11\x12\x13\x14\x15\
        \x16\x17\x94\x8c\x05numpy\x94\x8c\x05dtype\x94\x93\x94\x8c\x02i1\x94\x89\x88\x87\x94R\x94(K\x03\x8c\x01|\x94NNNJ\xff\
        \xff\xff\xffJ\xff\xff\xff\xffK\x00t\x94bK\x04K\x02K\x03\x87\x94\x8c\x01K\x94K\x01K\x00K\x02\x87\x94t\x94R\x94.";
    let want = ArrayD::from_shape_fn(IxDyn(&[2, 4, 3]), |at| (at[1] * 6 + at[0] * 3 + at[2]) as f32);
    assert_eq!(array_in(turned, &[2, 4, 3]), want);
}

#[test]
fn plain_values_are_read() {
    let list = |body: &[u8]| Pickle::parse("a", &whole(body)).unwrap().top().numbers().unwrap();
    assert_eq!(
        list(b"](K\x01J\xff\xff\xff\xffM\x00\x01\x8a\x01\x80\x8a\x00G?\xf8\x00\x00\x00\x00\x00\x00e"),
        [1.0, -1.0, 256.0, -128.0, 0.0, 1.5]
    );
    let dict = whole(b"}(U\x01aK\x01\x8c\x01aK\x02u\x8c\x01cNs");
    let p = Pickle::parse("a", &dict).unwrap();
    assert_eq!(p.top().get("a").unwrap().unwrap().number().unwrap(), 2.0);
    assert!(p.top().get("c").unwrap().is_none() && p.top().get("d").unwrap().is_none());
}

#[test]
fn hostile_pickles_are_refused_in_words() {
    let wrapped = |name: &str| whole(&array_of("numpy.core", name, "|", &[1], false, &[0; 8]));
    let short = |shape: &[u8], n: usize| whole(&array_of("numpy.core", "f4", "<", shape, false, &vec![0; n]));
    let encode_again = |n: usize| {
        let mut body = b"c_codecs\nencode\nq\x00X\x00\x01\x00\x00".to_vec();
        body.extend([b'x'; 256]);
        body.extend(b"\x8c\x06latin1\x86q\x01R");
        body.extend(b"0h\x00h\x01R".repeat(n));
        whole(&body)
    };
    let cases: Vec<(Vec<u8>, &[&str])> = vec![
        (whole(b"cnumpy.core.multiarray\nfromfile\n"), &["numpy.core.multiarray.fromfile"]),
        (whole(b"cnumpy\x1b[2J\nload\n"), &["numpy\\u{1b}[2J.load"]),
        (wrapped("c8"), &["dtype \"c8\"", "f4"]),
        (wrapped("V8"), &["dtype \"V8\""]),
        (whole(b"Pid\n"), &["PERSID"]),
        (whole(b"\x82\x01"), &["EXT1"]),
        (whole(b"\x84\x01\x00\x00\x00"), &["EXT4"]),
        (whole(b"\x97"), &["NEXT_BUFFER"]),
        (whole(b"(ios\nsystem\n"), &["INST"]),
        (whole(b"\x8f"), &["EMPTY_SET"]),
        (whole(b"\xff"), &["byte 2", "0xff"]),
        (whole(b"I1\n"), &["INT", "protocol 0"]),
        (b"\x80\x06N.".to_vec(), &["protocol 6", "2 to 5"]),
        (b"hello".to_vec(), &["0x68", "0x80"]),
        (Vec::new(), &["byte 0", "end of the file"]),
        (whole(b"\x8e\xff\xff\xff\xff\xff\xff\xff\xffab"), &["BINBYTES8", "18446744073709551615 bytes"]),
        (whole(b"\x95\x00\x00\x00\x00\x00\x01\x00\x00N"), &["FRAME", "1099511627776 bytes"]),
        (whole(b"\x8a\xff"), &["LONG1", "255 bytes"]),
        (whole(b"\x8a\x11aaaaaaaaaaaaaaaaa"), &["integer of 17 bytes"]),
        (short(&[3], 8), &["BUILD", "8 bytes of data", "[3]"]),
        (short(&[255; 8], 8), &["8 bytes of data"]),
        (short(&[255; 9], 8), &["at most 8 axes"]),
        (short(&[0, 255], 8), &["8 bytes of data"]),
        (whole(b"h\x07"), &["BINGET", "number 7"]),
        (whole(b""), &["STOP", "empty stack"]),
        (whole(b"]N(a"), &["APPEND", "empty stack"]),
        (whole(b"NN"), &["1 values left over"]),
        (whole(b"K\x01K\x02a"), &["APPEND", "1", "a list"]),
        (whole(b"]e"), &["APPENDS", "no open mark"]),
        (whole(b"}(NNNu"), &["SETITEMS", "key without a value"]),
        (encode_again(100), &["REDUCE", "again and again"]),
        (whole(b"K\x01)R"), &["REDUCE", "no name"]),
        (whole(b"cnumpy\nndarray\n)R"), &["REDUCE", "numpy.ndarray"]),
        (whole(b"cnumpy\ndtype\n)R"), &["name of a dtype"]),
        (whole(b"]K\x01b"), &["BUILD", "a list of 0"]),
        (whole(b"c_codecs\nencode\n\x8c\x01a\x8c\x05rot13\x86R"), &["latin1"]),
        (whole(&[&b"N"[..], &[op::FRAME; 9]].concat()), &["FRAME"]),
    ];
    for (bytes, words) in &cases {
        refused(bytes, words);
    }
    // A value that is encoded once may be used often.
    assert!(Pickle::parse("a", &encode_again(0)).is_ok());
}

#[test]
fn what_is_said_twice_is_kept_once() {
    // Ten lists, each holding the one before it ten times: ten billion values if they were copied.
    let mut body = b"]\x94".to_vec();
    for k in 0..10u8 {
        body.extend(b"](");
        body.extend([op::BINGET, k].repeat(10));
        body.extend(b"e\x94");
    }
    // All but the last list lie below it on the stack.
    body.splice(0..0, *b"(");
    body.extend([op::POP_MARK, op::BINGET, 10]);
    let bytes = whole(&body);
    let p = Pickle::parse("a", &bytes).unwrap();
    assert_eq!(p.heap.nodes.len(), 11);
    assert!(p.top().numbers().is_err());
    // One array under two names is one array.
    let mut body = b"(".to_vec();
    body.extend(array_of("numpy.core", "u1", "|", &[2], false, &[1, 2]));
    body.extend(b"\x94h\x00t");
    let bytes = whole(&body);
    let p = Pickle::parse("a", &bytes).unwrap();
    let Some([Value::Node(a), Value::Node(b)]) = p.heap.tuple(p.top) else { panic!("{:?}", p.top) };
    assert!(a == b && matches!(p.heap.nodes[a], Node::Array(Some(_))));
}

/// With every kind of value that the writer produces.
#[test]
fn what_is_written_comes_back() {
    let entries = vec![
        ("a", Out::Int(300)),
        ("b", Out::List(vec![Out::Float(1.5), Out::None, Out::Bool(true), Out::Int(1 << 40)])),
        ("c", Out::Doubles(&[0.25, -1.0])),
        ("d", Out::Text("é")),
    ];
    let mut bytes = Vec::new();
    write(&mut bytes, &Out::Dict(entries)).unwrap();
    let p = Pickle::parse("a", &bytes).unwrap();
    let item = |key: &str| p.top().get(key).unwrap().unwrap();
    assert_eq!(p.top().keys().unwrap(), ["a", "b", "c", "d"]);
    assert_eq!(item("a").number().unwrap(), 300.0);
    assert_eq!(item("c").numbers().unwrap(), [0.25, -1.0]);
    assert_eq!(item("d").text().unwrap(), "é");
    says(item("b").numbers(), &["a: b: found a list of 4"]);
}

#[test]
fn every_cut_and_every_changed_byte_of_a_named_array_is_survived() {
    let bytes = whole(&array_of("numpy._core", "f4", "<", &[2], false, &[0; 8]));
    for cut in 0..bytes.len() {
        refused(&bytes[..cut], &["byte"]);
    }
    for at in 0..bytes.len() {
        for flip in [0x01, 0x80, 0xff, 0x10] {
            let mut changed = bytes.clone();
            changed[at] ^= flip;
            if let Ok(p) = Pickle::parse("a", &changed) {
                let _ = (p.top().numbers(), p.top().number(), p.top().keys(), p.top().values(&[2], ""));
            }
        }
    }
}

proptest::proptest! {
    #[test]
    fn no_opcodes_make_it_panic(picks in proptest::collection::vec(0usize..40, 0..300)) {
        let codes = b"(}])NKJ\x8c\x85\x86\x87tes\x94h012abuRdl\x88\x89\x95\x93c\x8a\x00\x01q\n..";
        let body: Vec<u8> = picks.iter().map(|p| codes[p % codes.len()]).collect();
        let _ = Pickle::parse("a", &whole(&body)).map(|p| p.top().numbers().is_ok());
    }
}
