let s = vec3<f32>(guide_x[i], guide_y[i], guide_z[i]);
        let square = dot(s, s);
        // A slope of 0 has no direction, whatever the threshold is.
        let n = s * select(0.0, sqrt(stencil.step / (square + stencil.momentum)), square > 0.0);
        guide_x[i] = n.x;
        guide_y[i] = n.y;
        guide_z[i] = n.z;
